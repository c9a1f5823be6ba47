"""The studies `longer` and `noise`: their tables of made-up rows with known answers."""

import numpy as np
import pandas as pd
import pytest
from runs_by_hand import rows, write_run

from uavnav import stats, studies
from uavnav.evaluation import Protocol
from uavnav.report import longer, noise
from uavnav.report.longer import Where
from uavnav.runs import trials
from uavnav.studies import search

WIDE = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
"""Deviations of five seeds from their mean."""


def where(settings, algorithm, layouts="test", frames=1, limit=10):
    return Where(settings, algorithm, "tanh", layouts, limit, frames)


def flown(told, layouts, frames=1):
    """Rewards of five seeds by who flew, from their means."""
    return {where(*who, layouts, frames): mean + WIDE for who, mean in told.items()}


def test_who_leads_is_chosen_on_validation_layouts_and_its_lead_is_of_test_layouts():
    better = {("fast", "ppo"): 30.0, ("default", "ppo"): 20.0, ("fast", "dqn"): 10.0, ("tuned", "dqn"): 5.0}
    judged = {("fast", "ppo"): 24.0, ("default", "ppo"): 40.0, ("fast", "dqn"): 12.0, ("tuned", "dqn"): 50.0}
    rewards = flown(better, "validation") | flown(judged, "test")
    table = longer.table(rewards, {one: own - 24.0 for one, own in rewards.items()}, {("test", 10): 24.0})
    (leader,) = table.query("layouts == 'test' and leads").to_dict("records")
    assert (leader["settings"], leader["algorithm"], leader["value"]) == ("fast", "ppo", 24.0)
    assert leader["lead"] == pytest.approx(24 - 12)  # DQN tuned is better there, but was not chosen
    half = 2.306 * np.sqrt(2.5 / 5 + 2.5 / 5)  # t of 8 degrees of freedom
    assert leader["lead_high"] - leader["lead"] == pytest.approx(half, abs=1e-3)
    assert (leader["gap"], leader["above"], leader["scripted"]) == (0.0, 2, 24.0)


def test_a_gain_is_seed_by_seed_over_the_length_before():
    short, long = where("fast", "ppo"), where("fast", "ppo", frames=3)
    rewards = {short: 100 + 50 * WIDE, long: 120 + 50 * WIDE + 0.1 * WIDE[::-1]}
    table = longer.table(rewards, dict.fromkeys(rewards, np.zeros(5)), {}).set_index("frames")
    assert table.loc[3, "gain"] == pytest.approx(20)
    assert table.loc[3, "gain_high"] - 20 == pytest.approx(2.776 * 0.1 * np.sqrt(2.5 / 5), abs=1e-3)
    assert (table.loc[1, "trend"], table.loc[3, "trend"]) == ("", "rises")
    assert not table["leads"].any()  # nothing was flown on validation layouts


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(-9, 9, "saturated"), (1, 9, "saturated"), (1, 11, "rises"), (-11, -1, "falls"), (-11, 1, "open")],
)
def test_a_reward_is_saturated_where_its_change_lies_within_a_tenth_of_it(low, high, said):
    assert longer.trend(stats.Interval((low + high) / 2, low, high, 5), -100.0) == said


def evaluated(path, reward, protocol, **settings):
    """A run of two seeds that flew two test layouts."""
    one = [
        rows(seed, (9, 9, 0, 0, 0, 9, reward + seed), (9, 9, 0, 0, 0, 9, reward + seed)) for seed in (0, 1)
    ]
    episodes = pd.concat([seeds.assign(layout=[0, 1], mode="sampled") for seeds in one], ignore_index=True)
    run = write_run(path, *one, algorithm="ppo", **settings)
    kept(run, protocol.file("evaluation"), episodes, protocol)
    return run


def kept(folder, name, episodes, protocol):
    folder.mkdir(parents=True, exist_ok=True)
    episodes.attrs = protocol.header()
    episodes.to_parquet(folder / name)


def test_what_training_with_noise_gains_is_over_training_without_it_under_the_same_noise(tmp_path):
    protocol = Protocol("test", 2, 9, "noise=5")
    for trained, reward in ((0.0, 1.0), (5.0, 4.0)):
        faults = {"noise": trained, "lost": 0.0, "late": 0, "sticky": 0.0}
        evaluated(tmp_path / f"noise/{trained:g}/ppo/tanh", reward, protocol, faults=faults)
    rule = rows(0, (9, 9, 0, 0, 0, 9, 2.0), (9, 9, 0, 0, 0, 9, 3.0)).assign(layout=[0, 1])
    kept(tmp_path / "noise/baselines", protocol.file("reactive"), rule, protocol)
    tables, left_out = noise.gather([tmp_path])
    table = tables["noise"].set_index(["who", "trained"])
    assert left_out == []
    assert table.loc[("PPO tanh", 5.0), ["flown", "value", "gap", "gain", "above"]].tolist() == [
        5,
        4.5,
        2,
        3,
        2,
    ]
    assert table.loc[("PPO tanh", 0.0), ["flown", "value", "gap", "above"]].tolist() == [5, 1.5, -1, 0]
    assert np.isnan(table.loc[("PPO tanh", 0.0), "gain"])
    assert table.loc["reactive", "value"].tolist() == [2.5]


def test_folders_without_these_studies_have_no_tables(tmp_path):
    assert [study.gather([tmp_path]) for study in (longer, noise)] == [({}, [])] * 2


def test_the_tuned_settings_of_longer_training_are_those_of_the_best_trials():
    tried = trials.read(studies.HERE.parents[1] / "results/tuning/trials.csv", trials.COLUMNS)
    found = studies.configurations(studies.read("longer"), studies.HERE)
    tuning = search.plan(studies.read("tuning"), studies.HERE)
    for one in (one for one in found if one.out.parents[1].name == "tuned"):
        best = tuning.winner(one.config.algorithm, tried).config
        same = {"activation": one.config.activation, "seed": 200, "n_seeds": 20, "total_frames": 10_000_000}
        if one.config.algorithm == "dqn":
            same |= {"exploration_fraction": best.exploration_fraction / 10}
        assert one.config == best.replace(**same, keep_at=[0.1, 0.3])
