"""What the benchmarks make of measurements: rates, whole runs, ratios, and the file."""

import itertools
import os
from dataclasses import replace
from types import SimpleNamespace

import pytest

from uavnav import files
from uavnav.bench import page, training
from uavnav.bench.jobs import Measurement, Results
from uavnav.bench.page import read_sections, write_sections
from uavnav.bench.training import Clock


def watched(marks, starts=0):
    clock = Clock(0.0, SimpleNamespace(learning_starts=starts), 1.0)
    clock.marks = [*marks]
    return clock.result()


def test_the_rate_is_100_frames_a_second_though_the_first_intervals_took_60_seconds():
    assert watched([(1, 3.0), *((100 * n, 63.0 + n) for n in range(1, 9))])["rate"] == pytest.approx(100)


def test_a_run_with_a_start_up_of_12_s_at_500_frames_a_second_takes_2012_s_for_a_million():
    found = watched([(1000 * n, 12 + 2.0 * n) for n in range(9)])
    assert found == pytest.approx({"startup": 12, "rate": 500, "whole": 2012, "frames": 8000})


def test_20_s_until_50_000_frames_fill_a_buffer_are_start_up_and_950_000_frames_follow():
    found = watched([(50_000 + 10 * n, 20 + 0.02 * n) for n in range(1, 41)], 50_000)
    assert (found["startup"], found["rate"]) == pytest.approx((20, 500))
    assert found["whole"] == pytest.approx(20 + 1900)


def test_the_clock_stops_after_2_steady_seconds_but_never_before_3_steady_marks_of_learning(monkeypatch):
    now = itertools.count(100.0)
    monkeypatch.setattr(training.time, "time", lambda: next(now))
    slow = Clock(100.0, SimpleNamespace(learning_starts=50), seconds=2.0)
    assert [slow(frames) for frames in (20, 50, 60, 70, 80, 90, 100)] == [True] * 6 + [False]
    assert slow.marks[0] == (60, 0.0)
    short = Clock(100.0, SimpleNamespace(), seconds=0.0)
    assert [short(frames) for frames in (1, 2, 3, 4, 5)] == [True] * 4 + [False]


# -- tables --------------------------------------------------------------------------------------------------


PEER = Measurement("training/PPO, SB3", "", {"algorithm": "ppo"}, base="training/PPO, SB3")
TEN = replace(PEER, name="training/PPO, uavnav, 10 seeds", arguments={"n_seeds": 10})


def rows(*measured, missing=()):
    """The tables of measurements, each with what its rounds found."""
    found = [
        (one, turn, {"peak": 0.5} | result) for one, rounds in measured for turn, result in enumerate(rounds)
    ]
    return page.sections(Results(found, dict(missing)))


def configurations(lines, name):
    """A row by its columns' names."""
    head, row = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in (lines[0], find(lines, name))
    )
    return dict(zip(head, row, strict=True))


def find(lines, name):
    (line,) = (line for line in lines if line.startswith(f"| {name} |"))
    return line


def run(whole, rate=1e3):
    return {"startup": 10.0, "rate": rate, "whole": whole, "frames": 60_000, "peak": 0.5}


def test_ten_seeds_in_100_s_are_40_times_faster_each_than_one_of_400_s():
    lines = rows((PEER, [run(400.0)] * 3), (TEN, [run(100.0)] * 3))["training"]
    assert configurations(lines, "PPO, uavnav, 10 seeds") == {
        "": "PPO, uavnav, 10 seeds",
        "start-up [s]": "10",
        "frames/s": "10,000",
        "1 M frames": "0:01:40",
        "times": "40",
        "peak [GB]": "0.5",
    }
    assert configurations(lines, "PPO, SB3")["times"] == "1"


def test_two_processes_side_by_side_share_the_time_of_a_run():
    two = replace(PEER, name="training/PPO, SB3, two side by side", copies=2)
    shown = configurations(
        rows((PEER, [run(400.0)]), (two, [run(500.0, 2e3)]))["training"], "PPO, SB3, two side by side"
    )
    assert (shown["times"], shown["frames/s"]) == ("1.6", "2,000")


def test_a_ratio_is_the_median_over_the_rounds_that_both_have():
    base = Measurement("gymnasium/numpy", "", {}, base="gymnasium/numpy")
    one = replace(base, name="gymnasium/uavnav")
    found = [{"rate": float(rate)} for rate in (10, 40, 30)]
    numpy = [{"rate": float(rate)} for rate in (10, 10, 15)]
    assert configurations(rows((base, numpy), (one, found))["gymnasium"], "uavnav")["times"] == "2"
    assert configurations(rows((base, numpy[:2]), (one, found))["gymnasium"], "uavnav")["times"] == "2.5"


def test_the_world_is_compared_at_its_best_batch_size_with_the_numpy_world():
    base = Measurement("gymnasium/numpy", "", {})
    one = Measurement("world/compiled", "", {}, base="gymnasium/numpy")
    found = {"rate": 80.0, "16": 80.0, "256": 40.0}
    shown = configurations(rows((base, [{"rate": 1.0}]), (one, [found]))["world"], "compiled")
    assert (shown["16"], shown["256"], shown["times"]) == ("80", "40", "80")
    assert "times" not in rows((one, [found]))["world"][0]  # nothing to compare it with


def test_what_was_not_measured_is_named_below_the_table_or_alone():
    found = rows(
        (PEER, [run(400.0)]), missing={"training/PPO, SBX": "SBX is not there", "world/x": "failed"}.items()
    )
    assert found["training"][-4:] == ["", "Not measured:", "", "- `training/PPO, SBX`: SBX is not there"]
    assert found["world"] == ["", "Not measured:", "", "- `world/x`: failed"]


@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (1234567.8, "1,234,568"), (12.345, "12.3"), (0.01234, "0.0123")]
)
def test_numbers_have_three_digits_that_count(value, text):
    assert page.show("rate", value) == text


# -- the file ------------------------------------------------------------------------------------------------


def test_a_run_replaces_its_own_sections_keeps_the_others_and_leaves_no_file_aside(tmp_path):
    path = tmp_path / "docs" / "benchmarks.md"
    path.parent.mkdir()
    path.write_text("old head\n\n<!-- bench: growth -->\n## Growth\n\nmeasured once\n")
    write_sections(path, {"tasks": ["equal"], "world": ["slow"]})
    write_sections(path, {"world": ["fast"]}, "cut short")
    sections = read_sections(path)
    assert list(sections) == ["", "world", "tasks", "growth"]
    assert sections["growth"] == "## Growth\n\nmeasured once"
    assert sections["tasks"].endswith("equal")
    assert sections["world"].endswith("fast")
    assert "cut short; " in sections["world"]
    assert page.machine() in sections["tasks"]
    text = path.read_text()
    assert "slow" not in text
    assert text.startswith("# Benchmarks\n")
    assert os.listdir(path.parent) == ["benchmarks.md"]


def test_a_file_that_cannot_be_finished_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "benchmarks.md"
    path.write_text("before")

    def fail(aside, path):
        raise OSError("disk full")

    monkeypatch.setattr(files.os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_sections(path, {"world": ["fast"]})
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["benchmarks.md"]
