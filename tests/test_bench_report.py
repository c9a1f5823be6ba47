"""What the benchmarks make of measurements: rates, whole runs, ratios, targets, growth and the file."""

import itertools
import math
import os

import pytest
from safetensors.torch import load_file

from uavnav import files
from uavnav.algorithms import ALGORITHMS
from uavnav.bench import growth, ours, sections, watch
from uavnav.bench.page import read_sections, write_sections
from uavnav.bench.results import Results, number, ratio, table
from uavnav.bench.sections import Target
from uavnav.bench.watch import Clock, Mark, Stages, rate, whole_run


def results_of(**rounds):
    """Results whose measurements found these in their rounds, one process each; `__` stands for a slash."""
    results = Results()
    for name, found in rounds.items():
        results.found[name.replace("__", "/")] = [[one] for one in found]
    return results


# -- rates and whole runs ---------------------------------------------------------------------------------------------


def test_the_rate_is_100_frames_a_second_though_the_first_interval_took_60_seconds():
    marks = [Mark(0, 3.0), *(Mark(100 * n, 63.0 + n) for n in range(1, 9))]
    assert rate(marks) == pytest.approx(100)


def test_a_run_with_a_start_up_of_12_s_at_500_frames_a_second_takes_2012_s_for_a_million():
    found = whole_run([Mark(1000 * n, 12 + 2.0 * n) for n in range(9)], 0, 0)
    assert found == pytest.approx({"startup": 12, "rate": 500, "whole": 2012, "frames": 8000})


def test_dqns_whole_run_counts_50_000_frames_at_the_rate_before_learning_and_the_rest_after():
    before = [Mark(100 * n, 10 + 0.02 * n) for n in range(21)]  # 5,000 frames/s up to frame 2,000
    marks = before + [Mark(2000 + 10 * n, before[-1].at + 5 + 0.02 * n) for n in range(1, 41)]  # 5 s to compile, 500/s
    found = whole_run(marks, 2000, 50_000)
    assert (found["rate_before"], found["rate"]) == pytest.approx((5000, 500))
    assert found["startup"] == pytest.approx(15)
    assert found["whole"] == pytest.approx(15 + 10 + 1900)


def test_20_s_of_compilation_between_4_marks_before_learning_count_as_start_up():
    marks = [Mark(1000 * n, 15 + 0.1 * n + (20 if n > 2 else 0)) for n in range(4)]
    marks += [Mark(3000 + 10 * n, marks[-1].at + 0.02 * n) for n in range(1, 41)]
    found = whole_run(marks, 3000, 3000)
    assert (found["rate_before"], found["rate"]) == pytest.approx((10_000, 500))
    assert found["startup"] == pytest.approx(15 + 20)


def test_the_clock_stops_after_2_steady_seconds_or_500_frames_but_never_before_3_steady_marks(monkeypatch):
    now = itertools.count(100.0)
    monkeypatch.setattr(watch.time, "time", lambda: next(now))
    slow = Clock(launched=100.0, warm=50, frames=10**6, seconds=2.0)
    assert [slow(frames) for frames in (0, 20, 50, 60, 70)] == [True, True, True, True, False]
    assert slow.marks[0] == Mark(0, 0.0)
    short = Clock(launched=100.0, warm=0, frames=500, seconds=1e9)
    assert [short(frames) for frames in (400, 600, 800)] == [True, True, False]


@pytest.fixture
def work(monkeypatch):
    """A class whose `outer` takes 8 seconds of a made-up clock, 4 of them in `inner`, and that clock."""
    now = [0.0]
    monkeypatch.setattr(watch.time, "perf_counter", lambda: now[0])

    class Work:
        def outer(self):
            now[0] += 3
            self.inner()
            now[0] += 1

        def inner(self):
            now[0] += 4

    return Work, now


def test_stages_count_what_is_called_inside_another_once_and_the_rest_as_other(work):
    kind, now = work
    stages = Stages([(kind, "outer", "update"), (kind, "inner", "buffer")])
    kind().outer()
    stages.restart()
    kind().outer()
    now[0] += 2
    assert stages.shares() == pytest.approx({"update": 0.4, "buffer": 0.4, "other": 0.2})


def test_stages_are_counted_from_the_first_steady_mark_on(work):
    kind, now = work
    stages = Stages([(kind, "outer", "update")])
    clock = Clock(launched=0.0, warm=50, frames=100, seconds=1e9, stages=stages)
    kind().outer()
    for frames in (0, 50, 75, 100):
        clock(frames)
    now[0] += 2
    assert stages.shares() == {"other": 1.0}


def test_a_stage_of_a_function_that_is_gone_is_an_error():
    with pytest.raises(AttributeError, match="gone"):
        Stages([(Clock, "gone", "update")])


# -- medians, ratios, targets -----------------------------------------------------------------------------------------


def test_ratios_are_the_median_over_rounds_and_of_medians_where_rounds_differ_in_number():
    assert ratio([10, 40, 30], [10, 10, 15]) == 2
    assert ratio([10, 40, 30], [10, 20]) == 2
    assert ratio([], [1]) is ratio([1], []) is None


def test_results_are_the_mean_over_processes_and_the_median_over_rounds():
    results = Results()
    results.found["training/ppo/sb3/two"] = [
        [{"whole": 1}, {"whole": 3}],
        [{"whole": 9}, {"whole": 9}],
        [{"whole": 5}] * 2,
    ]
    assert results.values("training/ppo/sb3/two", "whole") == [2, 9, 5]
    assert results.median("training/ppo/sb3/two", "whole") == 5
    assert results.median("nothing", "whole") is None


def test_ten_seeds_in_100_s_are_40_times_faster_each_than_one_of_400_s():
    results = results_of(
        training__ppo__sb3__numpy=[{"whole": 400.0}] * 2, training__ppo__uavnav__10=[{"whole": 100.0}] * 2
    )
    assert sections.against_peer(results, "ppo", "uavnav/10", 10) == 40
    assert sections.against_peer(results, "dqn", "uavnav/10", 10) is None


@pytest.mark.parametrize(
    ("value", "at_most", "verdict"),
    [
        (8, False, "reached"),
        (20, False, "aim reached"),
        (7.9, False, "**not reached**"),
        (None, False, "not measured"),
        (20, True, "**not reached**"),
        (8, True, "aim reached"),
    ],
)
def test_the_verdict_of_a_least_of_8_and_an_aim_of_20_and_the_other_way_round(value, at_most, verdict):
    assert Target("", "", 8, 8 if at_most else 20, value, at_most).verdict == verdict


def test_the_table_of_targets_says_what_was_reached_and_what_was_not():
    results = results_of(gymnasium__numpy=[{"rate": 20_000.0}], gymnasium__uavnav=[{"rate": 10_000.0}])
    results.found["world/compiled, threads: 2"] = [[{"1": 1e3, "1024": 1.2e6}]]
    results.found["world/eager, threads: 2"] = [[{"1024": 1e5}]]
    results.found["memory/dqn"] = [[{"peak": 3.0}]]
    for seed, seconds in enumerate([30.0, 10.0, None]):
        results.found[f"fast/ppo/{seed}"] = [[{"seed": seed, "seconds": seconds, "frames": 1}]]
    text = "\n".join(sections.write_targets(results))
    assert "| world, best batch size, two cores | M steps/s | 0.9 | 3 | 1.2 | reached |" in text
    assert "| the same, against the NumPy world | times | 80 | - | 60 | **not reached** |" in text
    assert "against the NumPy world | times | 1 | 3 | 0.5 | **not reached** |" in text
    assert "| memory, DQN, ten seeds of 1 M frames | GB | 4 | 2 | 3 | reached |" in text
    assert "first policy with a reward of 88.5 | s | 90 | 20 | 30 | reached |" in text
    assert text.count("not measured") == len(sections.targets(results)) - 5


def test_a_seed_that_never_reaches_the_target_takes_for_ever():
    results = Results()
    for seed, (seconds, frames) in enumerate([(None, None), (10.0, 50_000), (None, None)]):
        results.found[f"fast/ppo/{seed}"] = [[{"seed": seed, "seconds": seconds, "frames": frames}]]
    assert math.isinf(sections.fast_median(results, "ppo"))
    text = "\n".join(sections.write_fast(results))
    assert "PPO, median never s:" in text
    assert "| 1 | 10 | 50,000 |" in text
    assert text.count("| - | - |") == 2


def test_the_best_of_a_row_is_compared_with_the_numpy_world_in_one_environment():
    results = results_of(gymnasium__numpy=[{"rate": 10_000.0}])
    results.found["world/compiled, 2 processes of 1 thread"] = [[{"16": 40_000.0}, {"16": 60_000.0}]]
    results.found["world/eager, threads: 1"] = [[{"1": 5_000.0, "16": 20_000.0}]]
    text = "\n".join(sections.write_world(results))
    assert "| 1 | - | 5,000 | 0.5 |" in text
    assert "| 16 | 100,000 | 20,000 | 10 |" in text
    assert sections.best_world(results) == [100_000.0]


def test_a_training_row_gives_the_time_per_seed_and_the_rates_of_all_seeds_together():
    watched = {"startup": 10.0, "rate": 1e3, "rate_before": 5e3, "frames": 60_000, "peak": 0.5}
    results = results_of(
        training__dqn__sb3__numpy=[watched | {"whole": 1000.0}],
        training__dqn__uavnav__10=[watched | {"whole": 500.0, "threads": 1, "processes": 2}],
    )
    text = "\n".join(sections.write_training(results))
    assert (
        "| uavnav, 10 seeds | batched | 2 × 1 | 1 × 60,000 | 10 | 50,000 | 10,000 | 0:08:20 | 0:00:50 | 20 | 0.5 |"
        in text
    )
    assert "| SB3, alone | NumPy | 1 | 1 × 60,000 | 10 | 5,000 | 1,000 | 0:16:40 | 0:16:40 | 1 | 0.5 |" in text


@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (1234567.8, "1,234,568"), (12.345, "12.3"), (0.01234, "0.0123")]
)
def test_numbers_have_three_digits_that_count(value, text):
    assert number(value) == text


def test_a_table_aligns_its_first_columns_left_and_the_others_right():
    assert table(["a", "b", "c"], [["x", "y", "1"]], left=2) == ["| a | b | c |", "|---|---|--:|", "| x | y | 1 |"]


def test_worlds_are_shares_of_the_papers_rate_and_memory():
    found = Results()
    for name, steps, peak in (("drone", 1e6, 0.5), ("noise=5.0", 7e5, 1.0)):
        found.found[f"worlds/{name}"] = [[{"4096": steps, "peak": peak}]]
    assert sections.write_worlds(found)[-2:] == [
        "| drone | 1,000,000 | 1 | 0.5 | 1 |",
        "| noise=5.0 | 700,000 | 0.7 | 1 | 2 |",
    ]


# -- growth -----------------------------------------------------------------------------------------------------------


def test_growth_of_x_to_the_1_5_is_fitted_and_the_largest_between_two_neighbours_is_named():
    assert growth.exponent([(x, 3 * x**1.5) for x in (1.0, 2.0, 8.0)]) == pytest.approx(1.5)
    assert growth.steepest([(1, 1.0), (2, 1.5), (8, 12.0)]) == pytest.approx(1.5)
    assert math.isnan(growth.exponent([(1, 1.0)]))
    assert math.isnan(growth.steepest([(1, 1.0)]))
    assert growth.line([(x, 3.0 + 0.5 * x) for x in (1, 2, 5, 40)]) == pytest.approx((3, 0.5))


SMALLEST = {"ppo": {"frames_per_batch": 2, "minibatch_size": 2, "epochs": 1}, "dqn": {}}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_parameters_of_a_hidden_width_of_16_are_those_of_the_networks_of_a_run(algorithm, tmp_path):
    config = ours.settings(algorithm, hidden=(16, 16), total_frames=2, n_worlds=1, **SMALLEST.get(algorithm, {}))
    run = ours.train(algorithm, config, str(tmp_path / "run"))
    tensors = load_file(run.path / "policy.safetensors")
    assert growth.parameters(algorithm, 16) == sum(tensor.numel() for tensor in tensors.values())


def grown(rate):
    """Results in which every point has a peak of 0.5 GB and the rate [frames/s] that a function gives."""
    results = Results()
    for point in growth.points():
        results.found[point.name] = [[{"rate": rate(point), "peak": 0.5}]]
    return results


def test_growth_says_what_is_fixed_and_per_seed_and_what_grows_faster_than_linearly():
    text = "\n".join(growth.section(grown(lambda point: 1e6 / (60 * point.size))))
    assert "| PPO | seeds: 1, 2, 5, 10, 20, 40 | 1.0, 2.0, 5.0, 10.0, 20.0, 40.0 | 1.00 (1.00) |" in text
    assert "min and 1 min a seed; 0.5 GB and" in text
    assert "PPO's time" not in text

    def quadratic(point):
        return 1e6 / (60 * (point.x**2 if (point.algorithm, point.axis) == ("ppo", "seeds") else point.size))

    text = "\n".join(growth.section(grown(quadratic)))
    assert "PPO's time with seeds, exponent 2.00 (between 1 to 2, 2 to 5" in text
    assert "DQN's time" not in text


def test_the_figure_of_growth_has_time_above_memory_and_parameters_for_the_hidden_width():
    panels = growth.draw(grown(lambda point: 1e6 / point.size)).axes
    assert [panel.get_ylabel() for panel in panels if panel.get_ylabel()] == [
        "time for 1 M frames a seed [min]",
        "peak memory [GB]",
    ]
    assert panels[-1].get_xlabel() == "parameters a seed"
    assert panels[-1].lines[0].get_xdata()[0] == growth.parameters("ppo", 16)


# -- the file ---------------------------------------------------------------------------------------------------------


def test_a_run_replaces_its_own_sections_keeps_the_others_and_leaves_no_file_aside(tmp_path):
    path = tmp_path / "docs" / "benchmarks.md"
    write_sections(path, {"parity": ["equal"], "world": ["slow"]}, 60.0)
    write_sections(path, {"world": ["fast"], "targets": ["reached"]}, 61.0)
    sections = read_sections(path)
    assert list(sections) == ["machine", "targets", "world", "parity"]
    assert sections["parity"].endswith("equal")
    assert sections["world"].endswith("fast")
    assert "in 0:01:01" in sections["machine"]
    assert "torch" in sections["parity"].splitlines()[2]
    text = path.read_text()
    assert "slow" not in text
    assert text.startswith("# Benchmarks\n")
    assert os.listdir(path.parent) == ["benchmarks.md"]


def test_a_file_that_cannot_be_finished_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "benchmarks.md"
    path.write_text("before")

    def replace(aside, path):
        raise OSError("disk full")

    monkeypatch.setattr(files.os, "replace", replace)
    with pytest.raises(OSError, match="disk full"):
        write_sections(path, {"world": ["fast"]}, 60.0)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["benchmarks.md"]
