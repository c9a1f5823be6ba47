"""Runs, zips and baselines side by side: known numbers, and what is refused."""

import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from made_up import episodes
from rich.console import Console

from uavnav.cli import commands
from uavnav.cli import compare as command
from uavnav.evaluation import EPISODES, Protocol, evaluate_policy
from uavnav.report import compare
from uavnav.report.compare import (
    Contender,
    apart,
    check,
    contend,
    improvement,
    metrics,
    page,
    pairs,
    rounded,
    seeds_of,
    survival,
    text,
)
from uavnav.report.configurations import read
from uavnav.report.tables import side_by_side
from uavnav.runs.metrics import EVALUATED
from uavnav.runs.tables import read_table
from uavnav.stats import Interval
from uavnav.tasks.baselines import reactive

main = functools.partial(commands.run, "compare")

PROTOCOL = Protocol().header()


def made_up(name, rewards, steps=10, protocol=PROTOCOL, **place):
    """Two episodes a seed, each of the reward of its seed."""
    flown = [
        (seed, steps, n, steps, 1, 2, 50, reward) for seed, reward in enumerate(rewards) for n in range(2)
    ]
    table = episodes("seed frame layout steps stops turns distance reward", *flown)
    return Contender(name, table, protocol, {"task": "drone"} | place, None)


ABOVE, BELOW = made_up("above", [3.0, 4.0, 5.0]), made_up("below", [1.0, 2.0, 3.0])


def test_means_are_over_seeds_with_intervals_and_the_ratios_to_steps_in_percent():
    found = metrics([ABOVE, BELOW]).set_index(["name", "metric"])
    assert found.loc[("above", "reward"), ["n", "mean"]].tolist() == [3, 4.0]
    interval = scipy.stats.ttest_1samp([3.0, 4.0, 5.0], 0).confidence_interval()
    assert found.loc[("above", "reward"), ["low", "high"]].tolist() == pytest.approx(list(interval))
    assert found.loc[("below", "turns"), "mean"] == pytest.approx(20.0)
    assert found.loc[("below", "speed"), "mean"] == pytest.approx(5.0)


def test_a_seed_of_above_beats_one_of_below_in_eight_and_a_half_of_nine_pairs():
    (pair,) = improvement([ABOVE, BELOW]).to_dict("records")
    assert pair["probability"] == pytest.approx(8.5 / 9)


def test_two_times_three_seeds_differ_by_welchs_interval_over_both_whichever_comes_first():
    scattered = made_up("scattered", [-30.0, 3.0, 33.0])
    for one, other in ((ABOVE, scattered), (scattered, ABOVE)):
        samples = [each.episodes.groupby("seed")["reward"].mean() for each in (one, other)]
        low, high = scipy.stats.ttest_ind(*samples, equal_var=False).confidence_interval()
        pair = dict(zip(*pairs([one, other]), strict=True))
        assert pair["more reward"] == rounded(Interval(samples[0].mean() - samples[1].mean(), low, high, 3))
        assert high - low > 100
        assert pair["over"] == "3 seeds"


def test_a_single_seed_has_no_probability_and_its_interval_is_over_its_episodes_on_the_same_layouts():
    one, other = made_up("one", [3.0]), made_up("other", [1.0])
    one.episodes["reward"] = [3.0, 5.0]
    pair = dict(zip(*pairs([one, other]), strict=True))
    assert (pair["more reward"], pair["over"]) == ("3.0 [−9.7, 15.7]", "2 episodes")
    assert pair["probability of more"] == pair["Holm's p"] == "–"
    turned = dict(zip(*pairs([other, ABOVE]), strict=True))
    assert [turned[key] for key in ("", "against", "more reward", "over")] == [
        "above",
        "other",
        "3.0 [0.5, 5.5]",
        "3 seeds",
    ]


def test_episodes_that_end_at_ten_steps_are_up_until_then():
    shares = survival([ABOVE])["above"]
    assert shares[shares.index < 10].iloc[-1] == 1.0
    assert shares[shares.index >= 10].iloc[0] == 0.0


def test_the_text_and_the_page_hold_every_contender_and_no_claim(capsys):
    text([ABOVE, BELOW], Console(width=120))
    said = capsys.readouterr().out
    assert "above minus below: 2.0 [−0.3, 4.3] of reward, over 3 seeds; a seed of it has more with" in said
    assert "probability 0.94" in said
    html = page([ABOVE, BELOW]).decode()
    for row in side_by_side(seeds_of([ABOVE, BELOW])):
        assert row[0] in html
    assert html.count("<figure") == 1  # survival; nothing was trained
    assert re.findall(">0.94<", html) == [">0.94<"]  # the probability
    seen = said + html.partition("</style>")[2]
    assert "claim" not in seen
    assert "the paper" not in seen


def test_what_episodes_do_not_count_is_a_dash():
    tables = {"all": seeds_of([ABOVE])["above"], "few": seeds_of([ABOVE])["above"].assign(turns=np.nan)}
    (row,) = [row for row in side_by_side(tables) if row[0] == "turning [%]"]
    assert row[1:] == ["20.0 (20.0 to 20.0)", "–"]


def test_episodes_under_another_limit_are_refused():
    other = made_up("short", [1.0], protocol=Protocol("test", EPISODES, 500).header())
    with pytest.raises(compare.RunError, match=r"above on 200 .* 10,000 steps and short on 200 .* 500 steps"):
        check([ABOVE, other])


def test_runs_of_two_worlds_are_said_in_one_line_not_to_be_of_one_measure(tmp_path, monkeypatch, capsys):
    fast, slow = (
        made_up("fast", [1.0], task="moving", speed_max=6.0),
        made_up("slow", [1.0], task="moving", speed_max=2.0),
    )
    assert apart([ABOVE, BELOW]) == apart([fast, fast]) == ""
    end = "flew in different tasks, so their rewards are not of one measure"
    noisy, exact = (
        compare.trained(name, read(Path(f"results/noise/{name}/ppo/tanh")), None) for name in ("5", "0")
    )
    assert apart([noisy, exact]) == f"5 (faults.noise=5.0) and 0 (faults.noise=0.0) {end}"
    assert apart([fast, slow]) == f"fast (speed_max=6.0) and slow (speed_max=2.0) {end}"
    monkeypatch.setattr(command, "contend", lambda names, *_: [ABOVE, BELOW, fast])
    assert main(["one", "other", "--json", "--out", str(tmp_path / "page.html")]) == 0
    out, err = capsys.readouterr()
    line = f"above (task=drone) and fast (task=moving) {end}"
    assert json.loads(out)
    assert err.splitlines()[0] == line
    assert f"<p>{line}.</p>" in (tmp_path / "page.html").read_text()


def test_scripted_policies_fly_in_the_world_of_the_first_run_and_kept_rows_are_of_the_papers():
    drone, moving = "results/worlds/vectorised/drone/ppo/tanh", "results/worlds/vectorised/moving/ppo/tanh"
    protocol = Protocol("test", 2, 9).header()
    flown = [compare.fly("straight", protocol, None, run).place for run in (drone, moving)]
    run, kept = contend(["results/vectorised/ppo/tanh", "reactive"])
    whole = Protocol().header()
    elsewhere = ("sensitivity/listed/dqn/tanh", "sensitivity/initial/dqn/tanh", "noise/5/dqn/tanh")
    assert [compare._kept("reactive", whole, f"results/{other}") for other in elsewhere] == [None] * 3
    assert [one["task"] for one in flown] == ["drone", "moving"]
    assert apart([run, kept]) == ""
    assert "sensor_arc" not in run.place


def test_a_scripted_policys_rows_beside_a_run_are_the_kept_ones_or_those_that_it_flies():
    """The kept ones are what it flies: see test_baselines."""
    _, kept = contend(["results/vectorised/ppo/tanh", "reactive"])
    assert kept.episodes.equals(pd.read_parquet("results/baselines/reactive.parquet"))
    short = Protocol("test", 20, 200).header()
    flown = compare.fly("reactive", short, None, "results/vectorised/ppo/tanh").episodes
    pd.testing.assert_frame_equal(flown, evaluate_policy(reactive, episodes=20, max_steps=200)[flown.columns])


def test_columns_are_named_without_the_folders_that_runs_share():
    assert compare._short(["results/a/ppo/tanh", "results/a/dqn/tanh", "reactive"]) == [
        "ppo/tanh",
        "dqn/tanh",
        "reactive",
    ]
    for alone in (["runs/ppo/tanh", "reactive"], ["/data/ppo", "reactive"], ["/data/ppo", "runs/ppo"]):
        assert compare._short(alone) == alone


def test_a_committed_run_is_read_and_not_evaluated():
    (run,) = contend(["results/vectorised/ppo/tanh"])
    assert len(run.episodes) == 20 * EPISODES
    assert run.configuration is not None


def test_what_is_no_run_flies_as_the_first_run_was_evaluated(monkeypatch):
    short = made_up("short", [1.0, 2.0], protocol=Protocol("test", 3, 40).header())
    monkeypatch.setattr(compare, "_of_run", lambda name: short)
    file = "results/algorithms/fast/ppo/tanh/policy.safetensors"
    _, rule, policy = contend(["short", "reactive", file])
    assert rule.protocol == policy.protocol == short.protocol
    assert rule.episodes["steps"].tolist() == [40] * 3
    assert sorted(policy.episodes["seed"].unique()) == [100, 101, 102, 103, 104]
    assert len(policy.episodes) == 15
    check([short, rule, policy])


def test_episodes_and_the_time_limit_are_of_all_who_are_compared(trained, tmp_path, capsys):
    run = shutil.copytree(trained("ppo").path, tmp_path / "run")
    assert main([str(run), "ppo-tanh", "straight", "--episodes", "3", "--max-steps", "40", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in rows} == {str(run), "ppo-tanh", "straight"}
    assert max(row["mean"] for row in rows if row["metric"] == "steps") == 40
    assert len(read_table(run / "evaluation-test-3-40.parquet", EVALUATED, "")) == 6


def test_metrics_come_as_json(monkeypatch, capsys):
    monkeypatch.setattr(
        command, "contend", lambda names, *_, **asked: [ABOVE._replace(name=name) for name in names]
    )
    assert main(["one", "other", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in rows} == {"one", "other"}


def test_a_page_makes_its_folder_and_where_there_can_be_none_that_is_said_before_anyone_is_read(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(command, "contend", None)
    (tmp_path / "file").write_text("mine")
    for out, why in ((tmp_path / "file" / "page.html", "Not a directory"), (tmp_path, "it is a folder")):
        assert main(["one", "other", "--out", str(out)]) == 2
        assert capsys.readouterr().err == (
            f"uavnav compare: {out}: cannot be written ({why}); give a path that can be written\n"
        )
    monkeypatch.setattr(command, "contend", lambda names, *_: [ABOVE, BELOW])
    monkeypatch.setattr(command, "page", lambda contenders: b"a page")
    assert main(["one", "other", "--out", str(tmp_path / "new" / "folder" / "page.html")]) == 0
    assert (tmp_path / "new" / "folder" / "page.html").read_bytes() == b"a page"
