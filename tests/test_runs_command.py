"""`uavnav runs`: what it says of runs that are finished, running, stopped, failed, and of what is no run."""

import json
import shutil

import pandas as pd
import pytest
import yaml

from uavnav.__main__ import main
from uavnav.algorithms.ppo import PPOConfig
from uavnav.cli.runs import row
from uavnav.runs import progress as told
from uavnav.training import heartbeat
from uavnav.training.recorder import Recorder

CONFIG = {
    "algorithm": "ppo",
    "activation": "relu",
    "preset": "fast",
    "seed": 3,
    "n_seeds": 2,
    "total_frames": 400_000,
    "n_envs": 128,
    "task": "drone",
    "reward": "eq14",
    "layouts": "train",
    "gamma": 0.99,
    "world": {},
}
NOW = 1_800_000_000.0
STARTED = "2027-01-15T07:00:00+00:00"  # an hour before


def write(path, status, progress=None, **config):
    """A run's folder as `uavnav runs` reads it."""
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(yaml.safe_dump(CONFIG | config))
    finished = {"frames": 401_408, "ended": "2027-01-15T07:58:20+00:00"} if status == "finished" else {}
    (path / "meta.json").write_text(json.dumps({"status": status, "started": STARTED} | finished))
    if progress is not None:
        (path / "progress.json").write_text(json.dumps(progress))
    return path


def test_a_finished_run_is_its_settings_frames_and_age(tmp_path):
    assert row(write(tmp_path / "run", "finished"), NOW) == {
        "run": str(tmp_path / "run"),
        "algorithm": "ppo",
        "activation": "relu",
        "task": "drone",
        "preset": "fast",
        "seeds": [3, 4],
        "frames": 401_408,
        "total": 400_000,
        "status": "finished",
        "reward_sampled": None,
        "reward_greedy": None,
        "age": 100,
    }


PROGRESS = {"frames": 100_000, "total": 400_000, "rate": 2000.0, "at": NOW - 59}


def test_a_run_that_wrote_its_progress_59_s_ago_runs_at_2000_frames_a_second_for_150_s_more(tmp_path):
    found = row(write(tmp_path / "run", "running", PROGRESS), NOW)
    assert (found["status"], found["frames"], found["total"]) == ("running", 100_000, 400_000)
    assert (found["frames_per_second"], found["seconds_left"]) == (2000, 150)


def test_a_rate_leaves_out_the_frames_of_before_a_resume_whenever_they_are_told(tmp_path, monkeypatch):
    """Of several processes the first to speak say 0 for the others."""
    clock = [0.0]
    monkeypatch.setattr(heartbeat.time, "perf_counter", lambda: clock[0])
    own = Recorder(tmp_path / "run", PPOConfig(total_frames=10_000_000))
    with own:
        for clock[0], frames in ((0.0, 0), (1.0, 0), (2.0, 5_000_000), (12.0, 5_010_000)):
            own.tell(frames)
        own.heartbeat.beat()
        assert told(tmp_path / "run")["rate"] == 1000


@pytest.mark.parametrize(
    "progress", [None, PROGRESS | {"at": NOW - 60}, {"frames": 1}, [], PROGRESS | {"rate": "soon"}]
)
def test_a_run_that_says_it_runs_and_was_silent_for_60_s_was_stopped(progress, tmp_path):
    found = row(write(tmp_path / "run", "running", progress), NOW)
    assert (found["status"], "seconds_left" in found) == ("stopped", False)


@pytest.mark.parametrize(("status", "shown"), [("interrupted", "stopped"), ("failed", "failed")])
def test_a_run_that_was_interrupted_is_stopped_and_one_that_failed_failed(status, shown, tmp_path):
    assert row(write(tmp_path / "run", status, PROGRESS), NOW)["status"] == shown


def test_rewards_are_means_over_the_test_episodes_in_each_mode(results):
    from uavnav.runs import Run

    path = next(path.parent for path in sorted(results.rglob("evaluation.parquet")))
    rows = Run(path).evaluation()
    found = row(path, NOW)
    for mode in ("sampled", "greedy"):
        assert found[f"reward_{mode}"] == pytest.approx(
            rows.loc[rows["mode"] == mode, "reward"].mean(), abs=1e-12
        )


def test_the_reward_of_a_run_with_a_goal_is_that_of_its_own_limit_and_no_other_protocol_is_shown(tmp_path):
    run = write(tmp_path / "run", "finished", task="goal")
    rows = pd.DataFrame({"mode": ["greedy", "sampled"], "reward": [1.0, 2.0]})
    rows.to_parquet(run / "evaluation-test-200-500.parquet")
    assert row(run, NOW)["reward_sampled"] is None
    rows.to_parquet(run / "evaluation-test-200-1000.parquet")
    assert (row(run, NOW)["reward_greedy"], row(run, NOW)["reward_sampled"]) == (1.0, 2.0)


def test_a_stopped_run_has_the_frames_of_its_newest_snapshot_or_else_of_its_last_word(tmp_path):
    run = write(tmp_path / "run", "interrupted", PROGRESS)
    assert row(run, NOW)["frames"] == 100_000
    for folder, frames in (("workers/0", 81_920), ("workers/1.2", 73_728), ("workers/1.2", 65_536)):
        (run / folder / "checkpoint").mkdir(parents=True, exist_ok=True)
        (run / folder / "checkpoint" / f"state-{frames:012d}-{'0' * 32}.safetensors").touch()
    assert row(run, NOW)["frames"] == 73_728
    write(run / "workers" / "2", "finished")
    assert row(run, NOW)["frames"] == 73_728


LATELY = {
    "rewards": [30.0, 32.0],
    "flying": [0.75, 1.0],
    "lengths": [400.0, 424.0],
    "curve": [-200.0, -100.0, 40.0],
}


def test_the_list_fits_80_columns_sorted_as_asked_and_json_holds_the_same(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.time", lambda: NOW)
    write(tmp_path / "results" / "a", "interrupted", preset="vectorised")
    write(tmp_path / "results" / "a" / "checkpoint", "finished")
    assert main(["runs"]) == 0
    assert "results/a" in capsys.readouterr().out
    write(
        tmp_path / "runs" / "ppo-paper" / "tanh-learning_starts=1000",
        "finished",
        activation="leaky_relu",
    )
    write(tmp_path / "runs" / "c", "running", PROGRESS | {"at": NOW, "lately": LATELY}, algorithm="dqn")
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["runs", "--watch"]) == 0  # which is no terminal
    out, err = capsys.readouterr()
    assert err == "uavnav runs: --watch: no terminal to renew, so this is shown once\n"
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[:2] == [
        "runs/c",
        "  ▁▃▇········· 25% 2k/s, 2 min left; reward/1k 31 ± 1, 88% open, 412 steps",
    ]
    assert lines[3].split() == ["run", "policy", "seeds", "frames", "status", "sampled", "greedy", "age"]
    assert lines[4].split() == ["runs/c", "dqn", "relu", "2", "100k/400k", "running", "60", "min"]
    assert lines[5].split()[1:] == ["ppo", "leaky_relu", "2", "401k", "finished", "2", "min"]
    assert main(["runs", "runs", "results", "--sort", "frames", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(one["frames"], one.get("lately")) for one in rows] == [
        (401_408, None),
        (100_000, LATELY),
        (0, None),
    ]


def test_what_is_no_run_is_one_line_and_the_others_are_listed(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "runs" / "good", "finished")
    write(tmp_path / "runs" / "odd", "finished", n_seeds="many")
    assert main(["runs"]) == 0
    out, err = capsys.readouterr()
    assert (
        err
        == "uavnav runs: left out: runs/odd/config.yaml: not a run's, its n_seeds=many; give a run's folder\n"
    )
    assert len([line for line in out.splitlines() if "shipped" not in line]) == 3  # a head, a run, a caption
    shutil.rmtree(tmp_path / "runs")
    assert main(["runs"]) == 0  # the policies that ship are left
    assert main(["runs", "runs"]) == 2
    line = "uavnav runs: runs: there is no such folder; give a folder that contains runs\n"
    assert capsys.readouterr().err == line
