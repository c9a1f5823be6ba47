"""The report on run folders written by hand: what is read, merged, labelled and left out, and what
report.md says.
"""

import functools
from pathlib import Path

import pytest
from runs_by_hand import LAYOUTS, behaved, found, rows, two, write_run

from uavnav.cli import commands
from uavnav.report import _write_all, docs, report
from uavnav.report.claims import PRIMARY
from uavnav.report.configurations import BINS, collect
from uavnav.report.content import gather
from uavnav.report.page import markdown
from uavnav.report.tables import table
from uavnav.runs.definitions import ALL, DEFINITIONS, LOG_CURVE, TOTALS
from uavnav.runs.metrics import EPISODE_COLUMNS, METRICS, Metric
from uavnav.runs.tables import RunError

pytestmark = pytest.mark.usefixtures("little_garbage", "undrawn")

main = functools.partial(commands.run, "report")
REWARD = "−7.00 [−19.71, 5.71]"  # Student's, of the seeds −8 and −6


def said(*folders):
    """report.md, without writing it."""
    return markdown(gather(folders))


def no_policy(*paths):
    return [f"{path}: no policy.safetensors there; give the folder of a finished run" for path in paths]


@pytest.fixture(scope="module")
def text(gathered):
    return markdown(gathered)


def test_speed_6_as_mean_of_ratios_and_7_as_ratio_of_means_over_two_seeds(text):
    (means,), (ratios,) = found(text, "tanh", ALL), found(text, "tanh", TOTALS)
    assert means[:3] == ["2", "4", "0.0%"]
    shares = [f"{mean} [{mean}, {mean}]" for mean in ("5.00", "0.50", "70.00")]
    assert means[3:] == [
        "200.0 [200.0, 200.0]",
        *shares,
        "1,400.0 [1,400.0, 1,400.0]",
        "6.00 [6.00, 6.00]",
        REWARD,
    ]
    assert ratios[4:7] == [f"{mean} [{mean}, {mean}]" for mean in ("2.50", "0.25", "60.00")]
    assert ratios[8:] == ["7.00 [7.00, 7.00]", REWARD]


def test_per_frame_is_of_all_1000_frames_and_stands_first_with_the_papers_own(text):
    (own,) = found(text, "tanh", PRIMARY)
    assert own[:3] == ["2", "4", "0.0%"]
    assert own[3:6] == ["200.0 [200.0, 200.0]", "1.00 [1.00, 1.00]", "0.10 [0.10, 0.10]"]
    assert own[6:] == [
        *(
            "24.00 [24.00, 24.00]",
            "1,400.0 [1,400.0, 1,400.0]",
            "2.80 [2.80, 2.80]",
            "−0.0140 [−0.0394, 0.0114]",
        )
    ]
    dqn, ppo = found(text, "tanh", f"the paper, {PRIMARY}")
    assert dqn[3:] == ["159.434", "–", "1.497", "62.558", "649.456", "4.07", "−0.0438"]
    assert ppo[-2:] == ["4.69", "0.0325"]


def test_a_log_of_fewer_than_4_episodes_is_missing_for_dqn_and_so_is_that_of_an_unknown_algorithm(results):
    of_four = rows(4, *[(n, 10, 0, 0, 0, 0, 9.0) for n in range(4)])
    write_run(results / "more", two(2, -1.0), two(3, -1.0), of_four, seed=2)
    write_run(results / "trpo", two(0, 1.5), algorithm="trpo", activation="mish")
    text = said(results)
    assert found(text, "tanh", LOG_CURVE)[0][-1] == "9.00"  # of seed 4 alone
    assert len(found(text, "mish", f"{LOG_CURVE}: missing")) == 1


def test_the_interquartile_mean_stands_below_the_mean_with_its_own_interval(tmp_path):
    write_run(
        tmp_path / "run", *(two(seed, reward) for seed, reward in enumerate([0.0, 1.0, 2.0, 3.0, 94.0]))
    )
    (mean,), (middle,) = (found(said(tmp_path), "tanh", ALL + more) for more in ("", ", interquartile mean"))
    assert mean[-1].startswith("20.00 [")
    assert middle[-1].startswith("2.00 [")
    assert mean[:3] == middle[:3] == ["5", "10", "0.0%"]


def test_one_seed_has_no_interval(text):
    (means,), (ratios,) = found(text, "relu", ALL), found(text, "relu", TOTALS)
    assert means == ["1", "2", "0.0%", "200.0", "5.00", "0.50", "70.00", "1,400.0", "6.00", "5.00"]
    assert not any("[" in configuration for configuration in means + ratios)


def test_the_papers_8_rows_stand_beside_ours_as_printed(text):
    assert len(found(text, "tanh", "the paper")) == 2
    assert found(text, "sigmoid", "the paper")[0][3:] == [
        *("211.367", "–", "0.626", "59.983", "797.7136", "4.984", "−5.666")
    ]


def test_evaluation_is_two_definitions_with_half_of_the_episodes_truncated_at_40_steps(text):
    assert found(text, "tanh", "greedy evaluation")[0] == [
        *("1", "2", "50.0% at 40 steps", "25.0", "10.00", "5.00", "37.50", "75.0", "3.75", "−3.00")
    ]
    assert found(text, "tanh", "sampled evaluation")[0][-1] == "0.50"
    assert len(found(text, "relu", "greedy evaluation: missing")) == 1


def test_the_last_100_episodes_are_each_seeds_own(tmp_path):
    early = [(frame, 10, 0, 0, 0, 10, -10.0) for frame in range(1, 51)]
    late = [(frame, 10, 0, 0, 0, 10, 2.0) for frame in range(51, 151)]
    write_run(tmp_path / "run", rows(0, *early, *late))
    text = said(tmp_path)
    assert found(text, "tanh", "all training episodes")[0][-1] == "−2.00"
    assert found(text, "tanh", "last 100 training episodes")[0][1:2] == ["100"]
    assert found(text, "tanh", "last 100 training episodes")[0][-1] == "2.00"


def test_six_missing_configurations_are_named_and_have_rows(text):
    names = "dqn sigmoid, dqn relu, dqn leaky_relu, ppo tanh, ppo sigmoid, ppo leaky_relu"
    assert f"2 of the paper's 8 configurations have finished; {names} have not." in text
    assert len(found(text, "sigmoid", "missing: no finished run")) == 2


def test_runs_of_other_seeds_are_merged_and_of_another_setting_named(results):
    write_run(results / "more", two(2, -10.0), seed=2)
    write_run(results / "faster", two(0, -1.0), lr=0.5)
    content = gather([results])
    merged = found(markdown(content), "tanh", "all training episodes")[0]
    assert merged[0] == "3"
    assert merged[-1] == "−8.00 [−12.97, −3.03]"
    named = "in no study; it differs from the main one in"
    assert f"{results / 'faster'}: {named} lr=0.5" in content.left_out


def test_runs_on_other_layout_files_or_in_another_world_are_not_merged(tmp_path):
    write_run(tmp_path / "a", two(0, -1.0))
    write_run(tmp_path / "b", two(1, -1.0), seed=1, meta={"layouts": LAYOUTS | {"k": 4, "sha256": "def"}})
    write_run(tmp_path / "c", two(2, -1.0), seed=2, meta={"versions": {"world": "2"}})
    configurations, _ = collect([tmp_path])
    assert [len(configuration.runs) for configuration in configurations] == [1, 1, 1]


def test_the_second_run_of_the_same_seed_is_named_and_skipped(results):
    write_run(results / "dqn" / "twin", two(1, 99.0), two(2, 99.0), seed=1)
    content = gather([results])
    first, second = results / "dqn" / "tanh", results / "dqn" / "twin"
    twin = f"{second}: its seed 1 is in {first} already, with the same settings"
    assert content.left_out == [twin, *no_policy(first, results / "ppo" / "relu")]
    assert found(markdown(content), "tanh", "all training episodes")[0][-1] == REWARD


def test_a_run_without_a_policy_is_named_once_and_its_rows_count(results):
    content = gather([results])
    assert content.left_out == no_policy(results / "dqn" / "tanh", results / "ppo" / "relu")
    assert content.replays is None
    assert found(markdown(content), "tanh", "all training episodes")[0][-1] == REWARD
    behaved(results / "dqn" / "tanh")  # of whose episodes is a table, but no more can be flown
    assert gather([results]).left_out == content.left_out


@pytest.mark.usefixtures("warm")
def test_broken_unfinished_and_foreign_folders_are_named_on_stderr_and_in_the_report(results, capsys):
    (write_run(results / "broken", two(0, 1.0), lr=1.0) / "episodes.parquet").write_bytes(b"PAR1")
    (write_run(results / "half", two(0, 1.0), lr=2.0) / "meta.json").write_text(
        '{"status": "running", "study": "by hand"}'
    )
    write_run(results / "columns", two(0, 1.0).drop(columns="steps"), lr=3.0)
    write_run(results / "seeds", two(7, 1.0), lr=4.0, seed=0)
    write_run(results / "table", two(0, 1.0), lr=5.0, meta={"layouts": None})
    write_run(results / "worlds", two(0, 1.0), lr=6.0, n_envs=0)
    (results / "thesis").mkdir()
    (results / "thesis" / "config.yaml").write_text("title: a thesis")
    (results / ".hydra").mkdir()
    (results / ".hydra" / "config.yaml").write_text("hidden: true")
    assert main([str(results)]) == 0
    lines = capsys.readouterr().err.splitlines()
    names = ("broken", "columns", "half", "seeds", "table", "thesis", "worlds", "dqn/tanh", "ppo/relu")
    text, page = (results / "report.md").read_text(), (results / "report.html").read_text()
    for name, line in zip(names, lines, strict=True):
        assert line.startswith(f"uavnav report: left out: {results / name}")
        assert f"- {line.removeprefix('uavnav report: left out: ')}\n" in text
        assert str(results / name) in page
    assert ".hydra" not in text


def test_tables_where_no_run_is_are_named_and_those_of_a_report_are_not(results):
    two(0, 1.0).to_parquet(results / "dqn" / "copy.parquet")
    for name in ("lost", "baselines", "tables"):
        (results / name).mkdir()
    two(0, 1.0).to_parquet(results / "lost" / "episodes.parquet")
    two(0, 1.0).to_parquet(results / "baselines" / "straight.parquet")
    two(0, 1.0).to_parquet(results / "tables" / "mine.parquet")
    configurations, left_out = collect([results])
    assert len(configurations) == 2
    assert left_out == [
        f"{results / 'dqn' / 'copy.parquet'}: is where no run is",
        f"{results / 'lost'}: has episodes.parquet and no config.yaml; not a run of this package",
    ]


def test_a_run_that_is_in_no_study_is_named(results):
    strange = write_run(results / "strange", two(0, 1.0), lr=0.5, init="orthogonal")
    line = f"{strange}: in no study; it differs from the main one in init=orthogonal, lr=0.5"
    assert line in gather([results]).left_out


@pytest.mark.usefixtures("warm")
def test_control_c_is_one_line_and_status_130_and_nothing_is_written(results, tmp_path, monkeypatch, capsys):
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr("uavnav.report.page.markdown", interrupted)
    monkeypatch.setattr("uavnav.report.docs.results", interrupted)
    assert main([str(results)]) == 130
    assert capsys.readouterr().err == "uavnav report: stopped; no report was written\n"
    monkeypatch.chdir(tmp_path)
    Path("README.md").write_text("<!-- results -->\n<!-- end of results -->")
    assert docs.main([str(results)]) == 130
    assert capsys.readouterr().err == "uavnav.report.docs: stopped; nothing was written\n"
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "README.md", *before]


def interrupted(*anything):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "there is no such folder; give"),
        (lambda path: path.write_text("x"), "is a file; give"),
        (lambda path: path.mkdir(), "contains no run; give"),
        (
            lambda path: (path / "a").mkdir(parents=True) or (path / "a" / "config.yaml").write_text("[1"),
            "no run that",
        ),
    ],
)
def test_a_folder_without_runs_is_one_line_and_status_2_and_nothing_is_written(
    tmp_path, capsys, make, message
):
    make(tmp_path / "results")
    before = sorted(tmp_path.rglob("*"))
    assert main([str(tmp_path / "results"), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith(f"uavnav report: {tmp_path / 'results'}: {message}")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.usefixtures("warm")
def test_an_out_that_cannot_be_written_is_a_run_error_and_leaves_nothing(results, tmp_path):
    (tmp_path / "out").write_text("x")
    (tmp_path / "taken" / "report.md").mkdir(parents=True)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "figures").write_text("x")  # which come last here: tables/ is not made either
    files = {"tables/a.csv": b"", "figures/b.png": b""}
    before = sorted(tmp_path.rglob("*"))
    for out in ("out", "taken", "half"):
        with pytest.raises(RunError, match="cannot be written"):
            report([results], tmp_path / out) if out != "half" else _write_all(tmp_path / out, files)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_given_twice_is_read_once(results):
    once, twice = gather([results]), gather([results, results, results / "dqn"])
    assert twice.left_out == once.left_out
    assert markdown(once) == markdown(twice)


def test_curves_are_reward_per_frame_in_a_25th_of_the_frames_and_a_seed_in_one_long_episode_is_in_all(
    tmp_path,
):
    """Two worlds: in one of seed 0 an episode of 20 steps ends with a collision in the last frame of the
    first bin.
    """
    width = 1000 // BINS
    first = (width, 20, 0, 0, 0, 0, 30.0)  # 40 spread over the bin, and -10
    rest = (1000, 480, 0, 0, 0, 0, 480.0, False, False)
    other = (1000, 500, 0, 0, 0, 0, 0.0, False, False)
    write_run(tmp_path / "run", rows(0, first, rest, other), rows(1, other, other), n_envs=2)
    (configuration,), _ = collect([tmp_path])
    found = configuration.curve
    assert found.index.tolist() == [(place + 0.5) * width for place in range(BINS)]
    assert found[0].tolist() == pytest.approx([30 / 40] + [0.5] * 24)
    # by Stable-Baselines3's log, of which the first episode ends with the first bin
    assert configuration.logged[0].tolist() == pytest.approx([float("nan")] + [30.0] * 24, nan_ok=True)
    assert found[1].tolist() == [0.0] * BINS


def test_the_report_says_how_runs_were_made(text):
    assert "- versions: torch 2.13.0, world 1\n" in text
    assert "- git commit: c0ffee\n" in text
    assert "- machine: processor an abacus, cores 2\n" in text
    assert "1:02:05" in text  # 3,725 s


def test_an_algorithm_and_an_activation_that_the_paper_has_not_get_rows_too(results):
    write_run(results / "trpo", two(0, 1.5), algorithm="trpo", activation="mish")
    text = said(results)
    assert "\n## TRPO\n" in text
    assert found(text, "mish", "all training episodes")[0][-1] == "1.50"
    assert found(text, "mish", "the paper") == []


@pytest.mark.usefixtures("warm")
def test_a_run_without_a_finished_episode_is_missing_in_every_definition_but_per_frame(tmp_path):
    write_run(tmp_path / "run", rows(0, (1000, 10, 0, 0, 0, 0, -1.0, False, False)))
    text = report([tmp_path]).path.with_suffix(".md").read_text()
    assert [len(found(text, "tanh", f"{definition}: missing")) for definition in DEFINITIONS] == [
        0,
        *[1] * (len(DEFINITIONS) - 1),
    ]
    assert found(text, "tanh", PRIMARY)[0][3] == "–"  # nothing per collision


def test_tables_of_nothing_still_hold_the_papers_4_rows():
    assert len(table({}, "ppo")) == 1 + 3 * 4


def test_runs_that_leave_out_what_a_metric_counts_are_read_beside_those_that_have_it(results, monkeypatch):
    write_run(results / "new", two(0, 1.0).assign(near=3), activation="sigmoid")
    write_run(results / "columns", two(0, 1.0).drop(columns="steps"), lr=3.0)
    monkeypatch.setitem(EPISODE_COLUMNS, "near", "int64")
    monkeypatch.setitem(METRICS, "near", Metric("near misses", "near"))
    content = gather([results])
    (refused,) = [line for line in content.left_out if "parquet" in line]
    assert refused.startswith(f"{results / 'columns' / 'episodes.parquet'}: ")
    text = markdown(content)
    assert found(text, "tanh", ALL)[0][-2:] == [REWARD, "–"]
    assert found(text, "sigmoid", ALL)[0][-1] == "3.00"


# -- settings ------------------------------------------------------------------------------------------------


def test_a_field_of_the_world_is_a_setting_of_its_own(tmp_path):
    write_run(tmp_path / "run", two(0, -1.0))
    ((configuration,), _) = collect([tmp_path])
    assert (configuration.settings["task"], configuration.settings["world.sensor_radius"]) == ("drone", 120.0)
    assert {"slots", "padding", "start_heading", "world"} & {*configuration.settings} == set()


def test_a_field_of_the_world_otherwise_is_named(tmp_path):
    write_run(tmp_path / "usual", two(0, -1.0), two(1, -1.0))
    for seed in (0, 1):
        write_run(tmp_path / f"listed{seed}", two(seed, -1.0), seed=seed, world={"slots": "listed"})
    write_run(tmp_path / "arc", two(0, -1.0), world={"sensor_arc": 360.0})
    content = gather([tmp_path])
    print(content.left_out)
    assert found(markdown(content), "tanh", PRIMARY)[0][0] == "2"
    named = "in no study; it differs from the main one in world"
    for name, how in (("listed0", "slots=listed"), ("listed1", "slots=listed"), ("arc", "sensor_arc=360.0")):
        assert f"{tmp_path / name}: {named}.{how}" in content.left_out


def test_another_task_is_another_configuration_and_its_world_has_no_defaults_of_the_drones(tmp_path):
    write_run(tmp_path / "drone", two(0, -1.0))
    write_run(tmp_path / "other", two(0, -1.0), task="gates", world={"width": 5})
    configurations, _ = collect([tmp_path])
    assert [configuration.settings["task"] for configuration in configurations] == ["drone", "gates"]
    assert [name for name in configurations[1].settings if name.startswith("world.")] == [
        "world.width",
        "world.version",
    ]


def test_a_world_that_is_no_table_is_named(tmp_path):
    write_run(tmp_path / "good", two(0, -1.0))
    strange = write_run(tmp_path / "strange", two(0, -1.0), world="flat")
    assert collect([tmp_path])[1] == [
        f"{strange / 'config.yaml'}: not a run's, its world=flat; give a run's folder"
    ]


def test_one_split_by_a_relative_and_a_full_path_is_the_same_setting(tmp_path):
    for seed, path in enumerate(("mine.safetensors", str(tmp_path / "mine.safetensors"))):
        write_run(
            tmp_path / "runs" / str(seed), two(seed, -1.0), seed=seed, layouts=path, meta={"layouts": LAYOUTS}
        )
    write_run(tmp_path / "runs" / "other", two(0, -1.0), layouts="yours.safetensors", meta={"layouts": {}})
    mine, yours = collect([tmp_path / "runs"])[0]
    assert len(mine.runs) == 2
    assert mine.settings["layouts"] == LAYOUTS["sha256"]
    assert yours.settings["layouts"] == "yours.safetensors"


def test_the_report_says_which_evaluation_it_read_and_which_not(tmp_path):
    flown = rows(0, (10, 10, 1, 1, 5, 50, -9.0), (40, 40, 4, 0, 10, 100, 3.0, False, True)).assign(
        mode="greedy"
    )
    flown["layout"] = [0, 1]
    write_run(tmp_path / "old", two(0, -1.0), evaluation=flown)
    flown.attrs = {"layouts": "test", "max_steps": 10_000}
    new = write_run(tmp_path / "new", two(1, -1.0), seed=1, evaluation=flown.assign(seed=1))
    flown.to_parquet(new / "evaluation-long.parquet")
    write_run(tmp_path / "none", two(2, -1.0), seed=2)
    other = write_run(tmp_path / "other", two(3, -1.0), seed=3)
    flown.assign(seed=3).to_parquet(other / "evaluation-test-2-40.parquet")
    text = said(tmp_path)
    other = "evaluation-test-2-40.parquet, 2 layouts (test), at most 10,000 steps"
    assert f"- evaluation: {other} ({tmp_path / 'other'})" in text
    read = "- evaluation: evaluation.parquet, 2 layouts"
    assert f"{read} (not known), at most 40 steps ({tmp_path / 'old'})" in text
    assert f"{read} (test), at most 10,000 steps; not read: evaluation-long.parquet ({new})" in text
    assert f"- evaluation: none ({tmp_path / 'none'})" in text
