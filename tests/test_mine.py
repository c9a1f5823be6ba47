"""A report on one's own runs: who is in it, how they are ranked, what is typical, and where it goes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from bad_input import put
from runs_by_hand import rows, two, write_policies, write_run

from uavnav.colours import OTHERS, PILOTS
from uavnav.report import charts, compare, mine, places, report
from uavnav.report.configurations import collect
from uavnav.report.content import gather
from uavnav.runs.tables import write_table
from uavnav.training.checkpoints import Checkpoints

OWN = {"study": ""}


def flown(*rewards, seed=0):
    """Test episodes in both modes, the sampled ones with these rewards, one a layout."""
    table = rows(seed, *[(10, 10, 0, 0, 0, 50, reward, True, False) for reward in rewards])
    table["layout"] = range(len(table))
    return pd.concat([table.assign(mode="greedy", reward=-99.0), table.assign(mode="sampled")])


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """One run of three seeds, one of a single seed, one without evaluation, one that was stopped, and the
    scripted policy's rows.
    """
    monkeypatch.chdir(tmp_path)
    folder = Path("runs")
    several = pd.concat([flown(reward, reward, seed=seed) for seed, reward in enumerate([1.0, 2.0, 3.0])])
    write_run(folder / "a", *(two(seed, 0.0) for seed in range(3)), evaluation=several, meta=OWN)
    write_run(folder / "b", two(0, 5.0), algorithm="ppo", evaluation=flown(9.0, 7.0, 8.0, 4.0), meta=OWN)
    write_run(folder / "late", two(0, 5.0), algorithm="ppo", lr=0.5, meta=OWN)
    stopped = write_run(
        folder / "stopped", two(0, 5.0), algorithm="ppo", meta=OWN | {"status": "interrupted"}
    )
    table = two(0, 5.0)
    episodes = {name: torch.from_numpy(table[name].to_numpy()) for name in table}
    Checkpoints(stopped / "checkpoint", {}).save(400, {"episodes": episodes}, {"frames": 400})
    scripted = flown(10.0, 10.0, 10.0, 10.0).query("mode == 'sampled'").drop(columns="mode")
    (folder / "baselines").mkdir()
    write_table(folder / "baselines" / "reactive.parquet", scripted.reset_index(drop=True))
    return folder


def test_runs_are_ranked_beside_the_scripted_policy_over_seeds_or_episodes_and_unfinished_ones_come_last(
    runs,
):
    written = report()
    assert written.path == runs / "report.html"
    text = (runs / "report.md").read_text()
    found = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")][2:7]
    assert [row[0] for row in found] == ["scripted policy, `reactive`", "b", "a", "late", "stopped"]
    assert found[1][1:5] == ["7.0 [3.6, 10.4]", "4 episodes", "0", "−3.0 [−6.4, 0.4]"]
    assert found[2][1:5] == ["2.0 [−0.5, 4.5]", "3 seeds", "0", "−8.0 [−10.5, −5.5]"]
    assert found[3][1] == found[4][1] == "not evaluated"
    assert found[4][-1] == "stopped at 400 of 1,000 frames"
    assert "lr=0.5" in text
    assert "at least two of its 8 configurations with 5 seeds each; here 0 have that many" in text
    page = written.path.read_text()
    assert "<title>My runs</title>" in page
    assert "location.reload" not in page
    assert page.count("<figure") == 2
    assert all((runs / "figures" / f"{name}-1.svg").exists() for name in ("ranking", "curves"))


def test_a_watched_page_loads_itself_again(runs):
    assert "location.reload" in report(watched=True).path.read_text()


def test_the_typical_episode_is_the_median_by_reward():
    table = flown(9.0, 7.0, 8.0, 4.0, 1.0).query("mode == 'sampled'")
    assert mine.typical(table) == (0, 1)  # of 1, 4, 7, 8, 9
    assert mine.typical(table[:4]) == (0, 1)  # of 4, 7, 8, 9 the lesser


@pytest.mark.usefixtures("undrawn", "brief")
def test_the_typical_episode_is_recorded_in_the_colour_of_its_run(tmp_path):
    for name, algorithm in (("one", "ppo"), ("other", "ppo"), ("third", "dqn")):
        path = write_policies(
            tmp_path / name, algorithm, n_seeds=2, lr=0.1 * len(name), task="drone", reward="eq14"
        )
        meta = json.loads((path / "meta.json").read_text())
        (path / "meta.json").write_text(json.dumps(meta | OWN | {"beyond_preset": {"world.x": 1}}))
    begun = mine.unfinished([tmp_path])
    found = mine.gather(collect([tmp_path])[0], begun, [tmp_path], tmp_path, print)
    shown = {one["label"]: one["accent"] for one in found.recorded["configurations"]}
    assert shown == {"(one)": PILOTS["ppo"], "(other)": OTHERS[0], "(third)": PILOTS["dqn"]}
    assert all(len(one["episodes"]) == 1 for one in found.recorded["configurations"])


def test_of_an_unfinished_run_a_worker_that_has_finished_counts_too(tmp_path):
    folder = write_run(tmp_path / "run", two(0, 5.0), meta=OWN | {"status": "interrupted"})
    for name in ("episodes.parquet", "progress.parquet"):
        (folder / name).unlink(missing_ok=True)
    write_run(folder / "workers" / "0", two(0, 5.0), meta=OWN)
    going = folder / "workers" / "1"
    put(going / "meta.json", json.dumps({"status": "interrupted"}))
    snapshot = {name: torch.from_numpy(column.to_numpy()) for name, column in two(1, 7.0).items()}
    Checkpoints(going / "checkpoint", {}).save(400, {"episodes": snapshot}, {"frames": 400})
    ((begun, _),) = mine.unfinished([tmp_path]).values()
    assert begun.episodes.groupby("seed").size().to_dict() == {0: 2, 1: 2}
    (axes,) = charts.curves({"begun": begun}, {}).figure.axes
    assert axes.get_legend_handles_labels()[1] == ["begun, n = 2"]


@pytest.mark.usefixtures("brief")
def test_damaged_episodes_of_scripted_policies_and_people_are_named_and_stop_nothing(runs, tmp_path):
    for name in ("reactive.parquet", "human.parquet"):
        (runs / "baselines" / name).write_bytes(b"no table")
    found = mine.gather(collect([runs])[0], mine.unfinished([runs]), [runs], tmp_path, lambda _: None)
    lines = [line for line in found.left_out if "baselines" in line]
    assert len(lines) == 2
    assert all("delete it" in line for line in lines)


@pytest.mark.usefixtures("brief")
def test_scripted_episodes_that_cannot_be_kept_are_ranked_and_their_file_is_named(runs, tmp_path):
    shutil.rmtree(runs / "baselines")
    put(tmp_path / "out" / "baselines", "no folder")
    found = mine.gather(collect([runs])[0], {}, [runs], tmp_path / "out", lambda _: None)
    assert found.groups[0].scripted is not None
    assert any("out/baselines" in line for line in found.left_out)


@pytest.mark.usefixtures("brief")
def test_people_are_ranked_with_runs_of_their_reward_alone_and_no_run_has_their_name(tmp_path):
    for name, more in (("you", {}), ("first", {"reward": "initial"})):
        meta = OWN | {"beyond_preset": more}
        write_run(tmp_path / name, two(0, 0.0), evaluation=flown(1.0, 2.0), meta=meta, **more)
    rewards = flown(3.0).query("mode == 'sampled'").drop(columns="mode").reset_index(drop=True)
    (tmp_path / "baselines").mkdir()
    write_table(tmp_path / "baselines" / "human.parquet", rewards)
    found = mine.gather(collect([tmp_path])[0], {}, [tmp_path], tmp_path, lambda _: None)
    assert sorted(sorted(one.name for one in group.contenders) for group in found.groups) == [
        ["./you", "you"],
        ["first"],
    ]


def test_an_interval_is_over_seeds_where_there_are_several_and_else_over_episodes():
    seeds, values = pd.Series([0, 0, 1, 1]), pd.Series([1.0, 3.0, 5.0, 7.0])
    mean, over = compare.of_episodes(values, seeds)
    assert (mean.value, mean.n, over) == (4.0, 2, "seeds")
    mean, over = compare.of_episodes(values, seeds * 0)
    assert (mean.value, mean.n, over) == (4.0, 4, "episodes")
    assert np.isfinite(mean.low)


def test_without_folders_a_report_reads_runs_or_else_results_and_never_writes_into_results(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("results").mkdir()
    assert places([], None) == ([Path("results")], Path("report"))
    Path("runs").mkdir()
    assert places([], None) == ([Path("runs")], Path("runs"))
    assert places([], "there") == ([Path("runs")], Path("there"))
    assert places(["results"], None) == ([Path("results")], Path("results"))


def test_a_run_in_a_folder_with_a_studys_name_is_ones_own_unless_it_names_a_study(tmp_path):
    """The folders of further studies are read apart."""
    mine_too = write_run(tmp_path / "noise" / "mine", two(0, 5.0), algorithm="ppo", meta=OWN)
    write_run(tmp_path / "noise" / "0", two(0, 5.0), meta={"study": "noise"})
    (found,), left_out = collect([tmp_path])
    assert ([run.path for run in found.runs], left_out) == ([mine_too], [])


def test_the_best_run_is_named_with_its_task_where_there_are_several(tmp_path):
    write_run(tmp_path / "a", two(0, 5.0), evaluation=flown(9.0, 7.0), task="moving", meta=OWN)
    write_run(tmp_path / "b", two(0, 5.0), algorithm="ppo", evaluation=flown(400.0, 380.0), meta=OWN)
    report([tmp_path])
    text = (tmp_path / "report.md").read_text()
    assert "Of your runs (Moving obstacles), **a** earns most: 8.0 [" in text


def test_scripted_policies_of_another_task_are_not_shown_beside_the_papers(tmp_path):
    write_run(tmp_path / "main", two(0, 5.0), algorithm="ppo", evaluation=flown(9.0, 7.0))
    (tmp_path / "baselines").mkdir()
    for name, header in (("reactive", {}), ("reactive-goal-test-200-1000", {"task": "goal"})):
        table = flown(10.0, 10.0).query("mode == 'sampled'").drop(columns="mode").reset_index(drop=True)
        table.attrs = header
        write_table(tmp_path / "baselines" / f"{name}.parquet", table)
    assert [*gather([tmp_path]).baselines] == ["reactive"]
