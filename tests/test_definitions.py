"""The metric definitions *per frame* and *log curve*: closed forms, plain loops over rows, and
Stable-Baselines3's own log.
"""

import itertools
import math
from collections import deque
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import episodes

from uavnav.algorithms import ALGORITHMS
from uavnav.runs import Run, paper
from uavnav.runs.definitions import (
    DEFINITIONS,
    LOG_CURVE,
    PER_FRAME,
    decimals,
    last_hundred,
    log_curve,
    per_frame,
    within,
    words,
)
from uavnav.runs.metrics import METRICS, Metric, per_seed

RESULTS = Path(__file__).parent.parent / "results"
COMMITTED = ("vectorised/dqn/sigmoid", "vectorised/ppo/tanh", "paper/ppo/tanh", "algorithms/fast/dqn/tanh")
SIX = {"stops": 100, "full_stops": 100, "turns": 100, "speed": 1}
"""The ratios, and what they are times."""


def own_episodes(*rows):
    """From (seed, frame, world, steps, distance, reward, terminated, truncated); half of the steps turn."""
    made = episodes("seed frame env steps distance reward terminated truncated", *rows)
    return made.assign(stops=1, turns=made["steps"] // 2)


CRASH, LIMIT, OPEN = (True, False), (False, True), (False, False)


# -- the same by plain loops ---------------------------------------------------------------------------------


def slow_per_frame(rows, frames):
    """One seed's: a dict of metrics."""
    sums = dict.fromkeys(("steps", "stops", "full_stops", "turns", "distance", "reward"), 0.0)
    collisions = 0
    for row in rows:
        for name in sums:
            sums[name] += row[name]
        collisions += bool(row["terminated"])
    found = {name: 100 * sums[name] / frames for name in ("stops", "full_stops", "turns")}
    found |= {"speed": sums["distance"] / frames, "reward": sums["reward"] / frames}
    return found | {
        name: sums[name] / collisions if collisions else math.nan for name in ("steps", "distance")
    }


def slow_log(rows, frames, unit, every):
    """One seed's entries, in order of time: a list of dicts. Steps of all worlds pass one by one."""
    ended = sorted(
        (row for row in rows if row["terminated"] or row["truncated"]), key=lambda row: row["frame"]
    )
    buffer, entries, count, place = deque(maxlen=100), [], 0, 0

    def dump():
        if buffer:
            entries.append({name: math.fsum(one[name] for one in buffer) / len(buffer) for name in METRICS})

    times = sorted(
        {*(row["frame"] for row in ended), *(range(every, frames + 1, every) if unit == "frames" else ())}
    )
    for time in times:
        now = []
        while place < len(ended) and ended[place]["frame"] == time:
            now.append(ended[place])
            place += 1
        for row in sorted(now, key=lambda row: row.get("env", 0)):
            own = {name: row[name] for name in ("steps", "distance", "reward")}
            own["speed"] = row["distance"] / row["steps"]
            buffer.append(
                own | {name: 100 * row[name] / row["steps"] for name in ("stops", "full_stops", "turns")}
            )
        if unit == "frames" and time % every == 0:
            dump()
        for _ in now if unit == "episodes" else ():
            count += 1
            if count % every == 0:
                dump()
    return entries


def slow_within(rows, column, windows, n_envs, collision):
    """One seed's, by each episode's overlap with each window."""
    found = []
    for low, high in windows:
        total = 0.0
        for row in rows:
            end, begin = row["frame"], row["frame"] - row["steps"] * n_envs
            at_end = collision if row["terminated"] else 0.0
            shared = max(0, min(high, end) - max(low, begin))
            total += (row[column] - at_end) * shared / (end - begin)
            total += at_end if low < end <= high else 0.0
        found.append(total / (high - low))
    return found


def assert_equal(table, slow):
    """table: a row a seed; slow: the same as dicts or lists by seed."""
    assert list(table.index) == list(slow)
    for seed, own in slow.items():
        expected = [own[name] for name in table] if isinstance(own, dict) else own
        np.testing.assert_allclose(table.loc[seed].to_numpy(), expected, rtol=1e-9, atol=1e-12)


def mean_of(entries):
    return {
        name: math.fsum(one[name] for one in entries) / len(entries) if entries else math.nan
        for name in METRICS
    }


def compare_with_loops(table, frames, n_envs, rhythms, windows):
    """Everything of a table of episodes, in both ways."""
    by_seed = {seed: part.to_dict("records") for seed, part in table.groupby("seed")}
    assert_equal(
        per_frame(table, frames), {seed: slow_per_frame(rows, frames) for seed, rows in by_seed.items()}
    )
    ended = table.loc[table["terminated"] | table["truncated"], "seed"].unique()
    for unit, every in rhythms:
        logs = {
            seed: mean_of(slow_log(rows, frames, unit, every))
            for seed, rows in by_seed.items()
            if seed in ended
        }
        assert_equal(log_curve(table, frames, unit, every), logs)
    for column, collision in (("reward", -10.0), ("distance", 0.0), ("terminated", 1.0)):
        slow = {seed: slow_within(rows, column, windows, n_envs, collision) for seed, rows in by_seed.items()}
        assert_equal(within(table, column, windows, n_envs, collision), slow)


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_runs_read_the_same_by_plain_loops(name):
    run = Run(RESULTS / name)
    windows = [(0, 100_000), (30_000.5, 70_000), (run.frames - 100_000, run.frames)]
    rhythm = ALGORITHMS[run.algorithm].rhythm(run.config)
    compare_with_loops(run.episodes, run.frames, run.config["n_envs"], [rhythm], windows)


@st.composite
def runs(draw):
    """Episodes, frames and worlds: episodes fill all frames of every world; the last may be open, others
    may be cut.
    """
    n_envs, length = draw(st.integers(1, 3)), draw(st.integers(1, 40))
    rows = []
    for seed in range(draw(st.integers(1, 3))):
        for world in range(n_envs):
            done = 0
            while done < length:
                steps = draw(st.integers(1, length - done))
                done += steps
                ends = draw(st.sampled_from([CRASH, LIMIT, OPEN] if done == length else [CRASH, LIMIT]))
                reward = draw(st.floats(-20, 100, allow_subnormal=False))
                rows.append(
                    (seed, done * n_envs, world, steps, draw(st.integers(0, 9 * steps)), reward, *ends)
                )
    return own_episodes(*draw(st.permutations(rows))), length * n_envs, n_envs


@settings(max_examples=60, deadline=None)
@given(runs(), st.integers(1, 7), st.lists(st.integers(0, 120), min_size=2, max_size=5, unique=True))
def test_made_up_runs_read_the_same_by_plain_loops(run, every, edges):
    table, frames, n_envs = run
    edges = sorted(edges)
    windows = [*itertools.pairwise(edges), (edges[0], edges[-1])]
    compare_with_loops(table, frames, n_envs, [("episodes", every), ("frames", every)], windows)


@settings(max_examples=60, deadline=None)
@given(runs(), st.lists(st.floats(0.5, 119.5), max_size=5, unique=True))
def test_windows_add_up_to_the_whole_whatever_their_edges(run, inner):
    table, frames, n_envs = run
    edges = [0, *sorted(edge for edge in inner if edge < frames), frames]
    widths = np.diff(edges)
    found = within(table, "reward", [*itertools.pairwise(edges)], n_envs, -10.0)
    np.testing.assert_allclose((found * widths).sum(axis=1), table.groupby("seed")["reward"].sum(), atol=1e-9)
    whole = within(table, "reward", [(0, frames)], n_envs, -10.0)[0]
    np.testing.assert_allclose(whole, per_frame(table, frames)["reward"], atol=1e-12)


def test_episodes_and_what_is_open_at_the_end_fill_every_frame_of_every_run():
    for path in sorted(RESULTS.rglob("episodes.parquet")):
        run = Run(path.parent)
        assert run.episodes.groupby("seed")["steps"].sum().tolist() == [run.frames] * len(run.seeds), path


# -- closed forms --------------------------------------------------------------------------------------------


def test_per_frame_counts_the_open_episode_and_steps_are_per_collision():
    """40 frames: 10 steps at 2 px and a crash, 10 at 4 px cut off by a time limit, 20 at 9 px in an open
    episode.
    """
    table = own_episodes(
        (0, 10, 0, 10, 20, -9.8, *CRASH), (0, 20, 0, 10, 40, 0.4, *LIMIT), (0, 40, 0, 20, 180, 1.8, *OPEN)
    )
    (row,) = per_frame(table, 40).to_dict("records")
    assert row == pytest.approx(
        {
            "steps": 40,
            "distance": 240,
            "stops": 7.5,
            "full_stops": 0,
            "turns": 50,
            "speed": 6,
            "reward": -7.6 / 40,
        }
    )


def test_seeds_without_a_finished_episode_have_no_log():
    table = own_episodes((0, 9, 0, 9, 0, 1.0, *CRASH), (1, 9, 0, 9, 0, 1.0, *OPEN))
    assert log_curve(table, 9, "frames", 3).index.tolist() == [0]
    assert log_curve(table, 9, "episodes", 4)["reward"].isna().tolist() == [True]  # one episode and no fourth
    assert log_curve(table[1:], 9, "frames", 3).shape == (0, len(METRICS))


def test_a_metric_of_a_users_own_is_in_every_reading(monkeypatch):
    monkeypatch.setitem(METRICS, "near", Metric("near misses", "near"))
    monkeypatch.setitem(METRICS, "slow", Metric("slow", "distance", 100.0))
    monkeypatch.setitem(METRICS, "lost", Metric("lost", "reward", over="frame"))
    table = own_episodes((0, 10, 0, 10, 20, -9.0, *CRASH), (0, 20, 0, 10, 40, -10.0, *CRASH)).assign(near=3)
    for found, near, slow, lost in (
        (per_frame(table, 20), 3, 300, -19 / 20),
        (log_curve(table, 20, "frames", 20), 3, 300, -9.5),
        (per_seed(table), 3, 300, -9.5),
    ):
        assert found.loc[0, ["near", "slow", "lost"]].tolist() == pytest.approx([near, slow, lost])
    without = per_frame(table.drop(columns="near"), 20)
    assert without["near"].isna().all()


def test_a_metric_in_the_words_and_decimals_of_a_reading():
    assert [words(name, PER_FRAME) for name in ("reward", "steps", "distance", "turns", "speed")] == [
        *(
            "reward per frame",
            "steps per collision",
            "distance per collision [px]",
            "turning [%]",
            "speed [px a step]",
        )
    ]
    assert words("reward", LOG_CURVE) == "reward per episode"
    assert [decimals("reward", definition) for definition in DEFINITIONS[:3]] == [4, 2, 2]


def test_the_papers_reward_per_frame_is_reward_over_steps_and_its_speed_distance_over_steps():
    assert paper.printed("dqn", "relu", "reward", per_frame=True) == -7.616 / 205.576
    assert paper.printed("dqn", "relu", "speed", per_frame=True) == 761.555 / 205.576
    assert paper.printed("dqn", "relu", "steps", per_frame=True) == 205.576
    assert math.isnan(paper.printed("dqn", "mish", "reward", per_frame=True))


# -- Stable-Baselines3 ---------------------------------------------------------------------------------------


def test_the_rhythm_of_a_log_is_the_algorithms_own_and_unknown_where_a_setting_is_missing():
    assert ALGORITHMS["dqn"].rhythm({}) == ("episodes", 4)
    assert ALGORITHMS["ppo"].rhythm({"frames_per_batch": 2048}) == ("frames", 2048)
    assert ALGORITHMS["a2c"].rhythm({"n_steps": 5, "n_envs": 16}) == ("frames", 8000)
    assert ALGORITHMS["ppo"].rhythm({}) is None
    assert ALGORITHMS["ppo"].rhythm({"frames_per_batch": "many"}) is None
    assert ALGORITHMS["ppo"]._replace(logs=()).rhythm({}) is None


def learned(algorithm):
    """Stable-Baselines3 learns in four worlds of short episodes: all that its logger held at each dump, and
    the episodes that ended.

    The episodes are those of the infos, from which it fills its own buffer.
    """
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import KVWriter, Logger
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv

    held, rows, rng = [], [], np.random.default_rng(0)

    class Short(gymnasium.Env):
        """1 to 49 steps, whatever is done."""

        observation_space = gymnasium.spaces.Box(-1, 1, (3,))
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            self.left = int(rng.integers(1, 50))
            return np.zeros(3, np.float32), {}

        def step(self, action):
            self.left -= 1
            return np.zeros(3, np.float32), float(rng.normal()), self.left == 0, False, {}

    class Held(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            held.append(dict(key_values))

        def close(self):
            pass

    class Watch(BaseCallback):
        def _on_step(self):
            for world, info in enumerate(self.locals["infos"]):
                if (one := info.get("episode")) is not None:
                    rows.append((0, self.num_timesteps, world, one["l"], 0, one["r"], *CRASH))
            return True

    own = {
        "ppo": {"n_steps": 32, "batch_size": 128, "n_epochs": 1},
        "dqn": {"learning_starts": 2_000, "train_freq": 64, "buffer_size": 10_000},
        "a2c": {"n_steps": 2},
    }[algorithm]
    worlds = DummyVecEnv([lambda: Monitor(Short())] * 4)
    model = getattr(sb3, algorithm.upper())("MlpPolicy", worlds, seed=1, device="cpu", **own)
    model.set_logger(Logger(None, [Held()]))
    model.learn(8_000 if algorithm == "a2c" else 4_000, Watch())
    return held, own_episodes(*rows), model.num_timesteps


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_the_log_curve_is_the_mean_of_what_stable_baselines3s_logger_holds(algorithm):
    held, table, frames = learned(algorithm)
    unit, every = ALGORITHMS[algorithm].rhythm({"frames_per_batch": 128, "n_steps": 2, "n_envs": 4})
    logged = {
        name: [one[key] for one in held if key in one]
        for name, key in (("reward", "rollout/ep_rew_mean"), ("steps", "rollout/ep_len_mean"))
    }
    assert len(logged["reward"]) >= (10 if algorithm == "a2c" else 30)
    assert len(table) > 110  # so that the oldest leave the window
    entries = slow_log(table.to_dict("records"), frames, unit, every)
    found = log_curve(table, frames, unit, every).loc[0]
    for name, values in logged.items():
        np.testing.assert_allclose([one[name] for one in entries], values, rtol=1e-9)
        assert found[name] == pytest.approx(np.mean(values), rel=1e-9)


def test_the_log_in_a_window_is_what_it_holds_at_each_frame_by_a_slow_loop():
    """Two seeds, 130 and 3 episodes of 1 to 9 frames; before the first has ended there is nothing to log."""
    rng, rows, windows = np.random.default_rng(0), [], [(0, 60), (60, 300), (500, 640)]
    for seed, count in enumerate((130, 3)):
        end = 0
        for _ in range(count):
            end += (steps := int(rng.integers(1, 10)))
            rows.append((seed, end, 0, steps, 0, float(rng.normal()), True, False))
    found = last_hundred(own_episodes(*rows), "reward", windows)
    for seed, (low, high) in itertools.product((0, 1), windows):
        held = []
        for frame in range(low, high):
            ended = [row[5] for row in rows if row[0] == seed and row[1] <= frame]
            held += [np.mean(ended[-100:])] if ended else []
        value = found.loc[seed, windows.index((low, high))]
        assert value == pytest.approx(np.mean(held)) if held else np.isnan(value)
