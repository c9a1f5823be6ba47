"""The numbers of the first screen, from the rows of the runs alone: plain loops over parquet files, and
nothing of the report's tables or functions.
"""

import itertools
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from tied import LINK

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
FIRST = (
    (ROOT / "README.md").read_text().partition("<!-- results -->")[2].partition("<!-- end of results -->")[0]
)
FOUR = ("tanh", "sigmoid", "relu", "leaky_relu")
PRINTED = {"tanh": 88.527, "sigmoid": 31.117, "relu": 43.598, "leaky_relu": 33.8}
STEPS = {"tanh": 2727.577, "sigmoid": 1538.434, "relu": 1730.587, "leaky_relu": 1444.961}
DQN_REWARD = {"tanh": -6.982, "sigmoid": -5.666, "relu": -7.616, "leaky_relu": -7.406}
DQN_STEPS = {"tanh": 159.434, "sigmoid": 211.367, "relu": 205.576, "leaky_relu": 209.794}
FRAMES = {"ppo": 1_001_472, "dqn": 1_000_000}
LABELS = {"tanh": "tanh", "sigmoid": "sigmoid", "relu": "ReLU", "leaky_relu": "leaky ReLU"}


def trained(algorithm, activation):
    return pd.read_parquet(RESULTS / "paper" / algorithm / activation / "episodes.parquet")


@pytest.fixture(scope="module")
def per_frame():
    """Reward over frames: a number a seed."""
    return {
        (algorithm, one): trained(algorithm, one).groupby("seed")["reward"].sum().to_numpy()
        / FRAMES[algorithm]
        for algorithm, one in itertools.product(FRAMES, FOUR)
    }


def last_100(rewards):
    first = [rewards[:n].mean() for n in range(1, min(100, len(rewards) + 1))]
    return [*first, *(sliding_window_view(rewards, 100).mean(1) if len(rewards) >= 100 else ())]


@pytest.fixture(scope="module")
def logs():
    """By configuration and seed: when each episode ended, and the mean of the last 100 then."""
    found = {}
    for key in itertools.product(FRAMES, FOUR):
        rows = trained(*key)
        rows = rows[rows["terminated"] | rows["truncated"]].sort_values(["seed", "frame"], kind="stable")
        found[key] = [
            (own["frame"].to_numpy(), np.array(last_100(own["reward"].to_numpy())))
            for _, own in rows.groupby("seed")
        ]
    return found


@pytest.fixture(scope="module")
def logged(logs):
    """The mean of Stable-Baselines3's log: DQN's of every fourth episode, PPO's every 2,048 frames."""
    found = {}
    for (algorithm, one), seeds in logs.items():
        means = []
        for ends, held in seeds:
            if algorithm == "dqn":
                means.append(held[3::4].mean())
            else:
                at = np.searchsorted(ends, np.arange(2048, FRAMES["ppo"] + 1, 2048), side="right")
                means.append(held[at[at > 0] - 1].mean())
        found[algorithm, one] = np.array(means)
    return found


@pytest.fixture(scope="module")
def flown():
    """Reward of sampled and greedy test episodes: by configuration and mode, a number a seed."""
    found = {}
    for algorithm, one in itertools.product(FRAMES, FOUR):
        rows = pd.read_parquet(RESULTS / "paper" / algorithm / one / "evaluation.parquet")
        for mode, own in rows.groupby("mode"):
            found[algorithm, one, mode] = own.groupby("seed")["reward"].mean().to_numpy()
    return found


def of_folder(*parts, rows="evaluation"):
    rows = pd.read_parquet(RESULTS.joinpath(*parts) / f"{rows}.parquet").query("mode == 'sampled'")
    return rows.groupby("seed")["reward"].mean().to_numpy()


def lines(begin):
    """The text of the bullet or row that begins so, its links as words."""
    (line,) = [line for line in FIRST.splitlines() if line.startswith(begin)]
    return LINK.sub(r"\1", line)


def says(line, value, digits=0):
    assert re.search(
        rf"(?<![\d.,]){re.escape(f'{value:.{digits}f}'.replace('-', '−'))}(?!\d|[,.]\d)", line
    ), (
        value,
        line,
    )


def welch(samples, weights):
    """The standard error of a contrast and Student's 97.5 % quantile, by Welch and Satterthwaite."""
    from scipy.stats import t

    parts = [w * w * one.var(ddof=1) / len(one) for one, w in zip(samples, weights, strict=True)]
    df = sum(parts) ** 2 / sum(p * p / (len(one) - 1) for p, one in zip(parts, samples, strict=True))
    return sum(parts) ** 0.5 * t.ppf(0.975, df)


def spans(line, value, half, digits=0, widened=1.0):
    """The interval behind a number has this half-width, or up to `widened` times as much."""
    number = re.escape(f"{value:.{digits}f}".replace("-", "−"))
    found = re.search(rf"(?<![\d.,]){number}(?: %)? \((−?[\d.]+) to (−?[\d.]+)(?: %)?\)", line)
    assert found, (value, line)
    low, high = (float(one.replace("−", "-")) for one in found.groups())
    rounding = 1.01 * 10.0**-digits
    assert low < value < high
    assert 1.9 * half - rounding < high - low < 2.1 * widened * half + rounding


def test_ppo_leads_dqn_by_this_share_of_the_papers_lead(per_frame):
    line = lines("- PPO beats")
    lead = np.mean([per_frame["ppo", one].mean() - per_frame["dqn", one].mean() for one in FOUR])
    printed = np.mean([PRINTED[one] / STEPS[one] - DQN_REWARD[one] / DQN_STEPS[one] for one in FOUR])
    says(line, 1000 * lead, 1)
    says(line, 1000 * printed, 1)
    half = welch(per_frame.values(), [0.25 if algorithm == "ppo" else -0.25 for algorithm, _ in per_frame])
    spans(line, 1000 * lead, 1000 * half, 1, widened=1.6)
    spans(lines("**PPO beats DQN; its lead"), 100 * lead / printed, 100 * half / printed, widened=1.6)
    pairs = itertools.product(FOUR, FOUR)
    assert min(per_frame["ppo", a].mean() - per_frame["dqn", b].mean() for a, b in pairs) > 0


def test_dqns_sigmoid_leads_surges_and_falls_in_training_and_not_afterwards(per_frame, logs, flown):
    line = lines("- Sigmoid is")
    best = max((per_frame["dqn", one] for one in FOUR if one != "sigmoid"), key=np.mean)
    printed = {one: DQN_REWARD[one] / DQN_STEPS[one] for one in FOUR}
    lead = printed["sigmoid"] - max(value for one, value in printed.items() if one != "sigmoid")
    samples = per_frame["dqn", "sigmoid"], best
    share = 100 * (samples[0].mean() - best.mean()) / lead
    spans(line, share, 100 * welch(samples, (1, -1)) / lead, widened=1.6)
    windows = []
    for ends, held in logs["dqn", "sigmoid"]:
        frames = np.arange(1_000_000)
        at = np.searchsorted(ends, frames, side="right")
        log = np.where(at > 0, held[at - 1], np.nan)
        windows.append(
            [np.nanmean(log[a:b]) for a, b in ((0, 300_000), (300_000, 600_000), (900_000, 1_000_000))]
        )
    before, surge, after = np.array(windows).T
    rise, lost = surge - before, surge - after
    share = lost.mean() / rise.mean()
    spans(line, 100 * share, 100 * welch([lost - share * rise], (1,)) / rise.mean())
    assert (before.mean(), surge.mean(), after.mean()) == pytest.approx((-4.8, 14.9, 0.9), abs=0.06)
    assert sum(lost / rise > 0.5) == 33
    assert max(FOUR, key=lambda one: flown["dqn", one, "sampled"].mean()) != "sigmoid"


def test_one_run_a_configuration_would_name_tanh_and_give_the_papers_order_so_often(per_frame, logged):
    line = lines("- The order of PPO's tanh and sigmoid")
    samples = per_frame["ppo", "tanh"], per_frame["ppo", "sigmoid"]
    assert max(FOUR, key=lambda one: per_frame["ppo", one].mean()) == "sigmoid"
    lead = samples[0].mean() - samples[1].mean()
    spans(line, 1000 * lead, 1000 * welch(samples, (1, -1)), 1, widened=1.6)
    draws = np.random.default_rng(0).integers(40, size=(4, 400_000))
    tanh, sigmoid, relu, leaky = (logged["ppo", one][own] for one, own in zip(FOUR, draws, strict=True))
    best = np.mean((tanh > sigmoid) & (tanh > relu) & (tanh > leaky))
    order = np.mean((tanh > relu) & (relu > leaky) & (leaky > sigmoid))
    assert (best, order) == (pytest.approx(0.295, abs=0.005), pytest.approx(0.005, abs=0.001))
    says(line, 30)
    says(line, 0.5, 1)


def test_ppos_lead_by_settings():
    line = lines("- PPO's lead depends")
    tuning = RESULTS / "tuning"
    folders = [next(tuning.glob(f"tuned/*/{one}/tanh")) for one in FRAMES]
    usual = [of_folder(tuning / "default" / one / "tanh") for one in FRAMES]
    fast = [of_folder("algorithms", "fast", one, name) for one in FRAMES for name in ("tanh", "sigmoid")]
    found = [of_folder(one) for one in folders]
    study = [of_folder("paper", one, name) for one in FRAMES for name in ("tanh", "sigmoid")]
    leads = []
    for samples, weights in (
        (usual, (1, -1)),
        (fast, (0.5, 0.5, -0.5, -0.5)),
        (found, (1, -1)),
        (study, (0.5, 0.5, -0.5, -0.5)),
    ):
        lead = sum(w * one.mean() for one, w in zip(samples, weights, strict=True))
        half = welch(samples, weights)
        leads.append(lead)
        for value in (lead, lead - half, lead + half):
            says(line, value)
    assert leads == pytest.approx([226, 155, -17, 159], abs=0.5)


def test_the_scripted_policy_is_ahead_of_the_best_mean_and_single_seeds_pass_it(flown):
    line = lines("- Without sensor noise")
    rule = pd.read_parquet(RESULTS / "baselines" / "reactive.parquet")["reward"].mean()
    best = max((own for (_, _, mode), own in flown.items() if mode == "sampled"), key=np.mean)
    spans(line, rule - best.mean(), welch([best], (1,)))
    for mode, count in (("sampled", 3), ("greedy", 6)):
        assert sum(int((flown["ppo", one, mode] > rule).sum()) for one in FOUR) == count
        says(line, count)
    learned = of_folder("learned", "drone", "ppo", "tanh")
    spans(line, learned.mean() - rule, welch([learned], (1,)))
    noisy = of_folder("noise", "0", "ppo", "sigmoid", rows="evaluation-test-200-10000-noise=5")
    script = pd.read_parquet(RESULTS / "noise" / "baselines" / "reactive-test-200-10000-noise=5.parquet")
    spans(line, noisy.mean() - script["reward"].mean(), welch([noisy], (1,)))


@pytest.mark.parametrize("algorithm", FRAMES)
@pytest.mark.parametrize("activation", FOUR)
def test_the_table_of_rewards(algorithm, activation, logged, flown):
    line = lines(f"| {algorithm.upper()} {LABELS[activation]} |")
    _, _, printed, training, unseen, _ = line.split("|")
    says(printed, (PRINTED if algorithm == "ppo" else DQN_REWARD)[activation], 1)
    for shown, seeds in (
        (training, logged[algorithm, activation]),
        (unseen, flown[algorithm, activation, "sampled"]),
    ):
        places = len(shown.split()[0].partition(".")[2])
        says(shown, seeds.mean(), places)
        _, low, high = (float(one.replace("−", "-")) for one in re.findall(r"−?\d+(?:\.\d+)?", shown))
        assert low < seeds.mean() < high
        half = 2.02 * seeds.std(ddof=1) / 40**0.5
        assert high - low == pytest.approx(2 * half, rel=0.15, abs=1.01 * 10.0**-places)


def test_the_scripted_policys_reward_ends_the_table():
    rule = pd.read_parquet(RESULTS / "baselines" / "reactive.parquet")["reward"].mean()
    says(lines("| scripted policy"), rule)
