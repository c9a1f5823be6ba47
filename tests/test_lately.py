"""What a run shows while it trains: what its seeds earn, which episodes are open, how long, and the curve."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console

import uavnav
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.runs import lately, progress
from uavnav.runs.lately import Lately
from uavnav.training import heartbeat
from uavnav.training.loop import make_collector, make_env
from uavnav.training.recorder import Interrupted

SHORT = {
    "n_envs": 4,
    "frames_per_batch": 64,
    "minibatch_size": 64,
    "epochs": 1,
    "hidden": (8,),
    "compile": "off",
}
CONFIG = PPOConfig(n_seeds=2, total_frames=1280, max_steps=25, **SHORT)


def slowly(config):
    """Each look of a run whose policy does not learn, step by step."""
    env = make_env(config, False)
    actor = config.make(False).actor
    rewards, terminated, steps = [], [], []
    for _, batch in zip(range(config.iterations), make_collector(env, actor, config), strict=False):
        rewards.append(batch["next", "reward"].squeeze(-1).double().sum((1, 2)).numpy())
        terminated.append(batch["next", "terminated"].squeeze(-1).any(-1).numpy())
        ended, counts = batch["next", "done"][:, :, -1, 0], batch["next", "episode", "steps"][:, :, -1]
        steps.append((counts * ~ended).double().mean(1).numpy())
    first = np.cumsum(rewards, 0)
    for row in range(config.iterations):
        since = max(row - 1, 0)  # 128 frames, or the 64 that there are
        yield {
            "rewards": 1000 * (first[row] - (first[since - 1] if since else 0)) / (64 * (row + 1 - since)),
            "flying": ~np.any(terminated[since : row + 1], 0),
            "lengths": steps[row],
        }


def test_each_look_is_what_a_slow_loop_counts_over_the_newest_tenth_open_episodes_included(tmp_path):
    config = CONFIG.replace(lr=0.0)
    found = []
    look = lately.Watch.look
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lately.Watch, "look", lambda *given: found.append(look(*given)) or found[-1])
        run = uavnav.ppo.train(config, tmp_path / "run", quiet=True)
    assert len(found) == 20
    for mine, theirs in zip(found, slowly(config), strict=True):
        assert mine.rewards == pytest.approx(theirs["rewards"], rel=1e-5)
        assert mine.flying == pytest.approx(theirs["flying"].mean(1))
        assert mine.lengths == pytest.approx(theirs["lengths"])
    whole = 1000 * run.episodes["reward"].sum() / 2 / 1280
    ends = [next(row for row in range(20) if (row + 1) * 12 // 20 > point) + 1 for point in range(12)]
    sizes = [last - first for first, last in itertools.pairwise([0, *ends])]
    assert np.average(found[-1].curve, weights=sizes) == pytest.approx(whole)
    assert run.meta["lately"] == found[-1].model_dump()


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("processes", [1, 2])
def test_a_run_that_was_resumed_ends_with_the_curve_of_one_that_was_not(processes, tmp_path, capfd):
    how = {"quiet": True, "processes": processes}
    whole = uavnav.ppo.train(CONFIG, tmp_path / "whole", **how)
    with pytest.raises(Interrupted):
        uavnav.ppo.train(CONFIG, tmp_path / "run", until=640, **how)
    run = uavnav.ppo.train(CONFIG, tmp_path / "run", processes=processes)
    assert "resumed at 640 of 1,280" in capfd.readouterr().out
    for name, values in whole.meta["lately"].items():
        assert run.meta["lately"][name] == pytest.approx(values, abs=1e-3)


def test_a_run_that_is_stopped_twice_between_two_rows_of_progress_keeps_its_curve(tmp_path, monkeypatch):
    monkeypatch.setattr("uavnav.algorithms.replay.LOG_FRAMES", 500)
    config = DQNConfig(n_envs=4, total_frames=1_200, learning_starts=1_200, hidden=(8,), compile="off")
    whole = uavnav.dqn.train(config, tmp_path / "whole", quiet=True)
    for until in (600, 640):
        with pytest.raises(Interrupted):
            uavnav.dqn.train(config, tmp_path / "run", until=until, quiet=True)
    run = uavnav.dqn.train(config, tmp_path / "run", quiet=True)
    curve, expected = run.meta["lately"]["curve"], whole.meta["lately"]["curve"]
    assert curve[:5] == pytest.approx(expected[:5], abs=1e-3)  # parts of 100 frames
    assert len({*curve}) > 2


def test_workers_curves_count_by_their_seeds_as_far_as_all_have_come():
    two = Lately(rewards=[1.0, 2.0], flying=[0.0, 1.0], lengths=[5.0, 6.0], curve=[1.0, 2.0, 3.0])
    one = Lately(rewards=[4.0], flying=[0.5], lengths=[7.0], curve=[4.0, 5.0])
    both = lately.all_seeds([two, one])
    assert (both.rewards, both.flying, both.lengths) == ([1.0, 2.0, 4.0], [0.0, 1.0, 0.5], [5.0, 6.0, 7.0])
    assert both.curve == [2.0, 3.0]
    assert lately.all_seeds([two, lately.NOTHING]).curve == []
    resumed = Lately(curve=[2.0, 4.0])
    assert lately.all_seeds([resumed, resumed]).curve == [2.0, 4.0]


def test_the_line_fits_80_columns_and_a_reward_that_is_no_number_stops_no_heart_beat(tmp_path):
    console = Console(width=200)
    worst = Lately(rewards=[-199.9, -0.1], flying=[1.0], lengths=[62_500.0], curve=[1.0] * 12)
    assert console.measure(lately.line(99_999_999, 10**8, 134_567.0, worst)).maximum <= 80
    assert lately.line(0, 10, None, lately.NOTHING) == "············ 0%"
    watch = lately.Watch([0], 1, 10)
    columns = {"seed": [0], "env": [0], "frame": [1], "reward": [np.nan], "terminated": [True]}
    watch.add({name: np.array(column) for name, column in columns.items()})
    env = make_env(CONFIG.replace(n_seeds=1, n_envs=1), False)
    env.reset()
    heartbeat.tell(tmp_path, 5, 10, None, watch.look(env.state, 5))
    assert progress(tmp_path)["lately"].rewards == [0.0]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(40, "40 s"), (240, "4 min"), (3 * 3600, "3 h"), (12 * 86_400, "12 days"), (95, "2 min")],
)
def test_a_span_is_in_its_own_unit(seconds, words):
    assert lately.span(seconds) == words


def test_of_20000_seeds_1000_are_told_so_that_the_file_stays_small_enough_to_be_read(tmp_path):
    numbers = torch.rand(20_000, 1, generator=torch.Generator().manual_seed(0)).double()
    state = SimpleNamespace(reward=numbers, steps=numbers)
    told = lately.Watch(range(20_000), 1, 100).look(state, 10)
    heartbeat.tell(tmp_path, 10, 100, 1.0, lately.all_seeds([told, told]))
    assert [len(one) for one in (told.rewards, progress(tmp_path)["lately"].rewards)] == [1000, 1000]
    assert told.rewards[999] == pytest.approx(100 * float(numbers[999, 0]))
