"""The whole of a report: its page, Markdown, tables and figures, and what else may be in them."""

import math
import pickle
import re
import warnings

import numpy as np
import pandas as pd
import pytest
from runs_by_hand import behaved, found, rows, trained, two, write_run

from uavnav.report import Written, _write_all, report
from uavnav.report.claims import PRIMARY
from uavnav.report.content import gather
from uavnav.report.page import FURTHER, SECTIONS, contents, markdown, sections
from uavnav.runs.definitions import ALL, TOTALS
from uavnav.runs.metrics import METRICS, Metric
from uavnav.runs.tables import RunError
from uavnav.tasks import layouts

pytestmark = pytest.mark.usefixtures("little_garbage", "warm_module")


def test_a_metric_is_one_line_and_on_the_page_in_the_csv_and_in_report_md(results, monkeypatch, undrawn):
    monkeypatch.setitem(METRICS, "stood", Metric("stood", "stops", 1000.0, unit="‰", better=-1))
    written = report([results])
    page, text = written.path.read_text(), written.path.with_suffix(".md").read_text()
    assert page.count('<th scope="col" role="columnheader">stood [‰]</th>') == 2
    assert (
        '<td role="cell" data-of="stood [‰]">50.00 <span class="interval">[50.00, 50.00]</span></td>' in page
    )
    # of totals
    assert '<td role="cell" data-of="stood [‰]">25.00 <span class="interval">[25.00, 25.00]</span>' in page
    assert found(text, "tanh", ALL)[0][-1] == "50.00 [50.00, 50.00]"
    assert found(text, "sigmoid", "the paper")[0][-1] == "–"
    csv = pd.read_csv(results / "tables" / "metrics.csv").set_index(["algorithm", "definition", "metric"])
    assert csv.loc[("dqn", TOTALS, "stood"), "mean"] == 25


def test_further_activations_change_neither_the_seeds_nor_the_figures_of_the_papers_four(
    results, monkeypatch
):
    for others in ("_curves", "_paths", "_places"):
        monkeypatch.setattr(f"uavnav.report.figures.{others}", lambda *anything: [])
    for activation in ("tanh", "sigmoid", "relu", "leaky_relu"):
        write_run(results / "four" / activation, two(0, 1.0), two(1, 2.0), activation=activation, lr=0.5)
    write_run(results / "four" / "gelu", two(0, 1.0), activation="gelu", lr=0.5)
    gathered = gather([results])
    intervals = next(one for one in gathered.figures if one.name == "configurations-reward")
    assert "gelu" not in intervals.drawn.alt
    assert not gathered.tables["speed"]["configuration"].str.contains("gelu").any()
    assert {*gathered.tables["wide"]["activation"]} == {"tanh", "sigmoid", "relu", "leaky_relu", "gelu"}
    page = contents(gathered, results)["report.html"].decode()
    assert page.count("1 to 2 seeds of 1,000 frames") == 1  # PPO's relu has one
    text = markdown(gathered)
    assert found(text, "DQN gelu", PRIMARY) == [["1", "0.0020", "200.0", "2.80"]]
    assert "Activations beyond the paper's, after 1,000 frames: " in text


@pytest.fixture(scope="module")
def whole(once, little_garbage, warm_module):
    """A folder with runs of the paper's algorithms and of a third one, what is said of them, without a
    warning, and the report that says it; the same for all processes.
    """
    folder = once("whole-report", write_whole)
    gathered = pickle.loads((folder / "gathered").read_bytes())
    return folder / "results", gathered, Written(folder / "one" / "report.html", gathered.left_out)


def write_whole(folder):
    path = folder / "results"
    episodes = rows(0, (10, 10, 1, 1, 5, 50, -9.0), (40, 40, 4, 0, 10, 100, 3.0, False, True)).assign(
        mode="sampled"
    )
    for algorithm in ("a2c", "dqn", "ppo"):
        run = write_run(
            path / algorithm, two(0, -6.0), two(1, -8.0), algorithm=algorithm, gamma=0.9, evaluation=episodes
        )
        behaved(run)
        trained(run, algorithm, action=9)
    more = {"algorithm": "a2c", "activation": "relu", "gamma": 0.9}
    trained(write_run(path / "a2c-relu", two(0, 1.0), two(1, 2.0), **more), "a2c", action=9)
    write_run(path / "short", two(0, 5.0), meta={"frames": 500, "study": "wide"}, gamma=0.9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gathered = gather([path])
    _write_all(folder / "one", contents(gathered, path))
    (folder / "gathered").write_bytes(pickle.dumps(gathered))


@pytest.mark.slow
def test_two_reports_are_the_same_bytes(whole, monkeypatch):
    path, _, first = whole
    assert first.left_out == []
    second = report([path], path.parent / "two")
    files = [
        {
            str(file.relative_to(one.path.parent)): file.read_bytes()
            for file in one.path.parent.rglob("*")
            if file.is_file()
        }
        for one in (first, second)
    ]
    assert sorted(files[0]) == sorted(files[1])
    assert [name for name in files[0] if files[0][name] != files[1][name]] == []


def test_a_report_is_a_page_its_markdown_tables_and_figures_in_two_forms(whole):
    *_, written = whole
    assert written.path.name == "report.html"
    out = written.path.parent
    kinds = {"report.html", "report.md", "preview.png", "figures", "tables"}
    assert {file.name for file in out.iterdir()} == kinds
    drawn = {file.stem for file in out.glob("figures/*.svg")}
    assert drawn == {file.stem for file in out.glob("figures/*.png")}
    assert drawn >= {
        "configurations-episodes",
        "configurations-reward",
        "curves-dqn-reward",
        "curves-ppo-reward",
        "trajectories",
        "heat",
    }
    assert "survival" in drawn
    assert len(drawn) <= 12
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in out.glob("figures/*.png"))
    page = written.path.read_text()
    assert page.count("data:image/svg+xml,") == 2 * len(drawn)  # for a page and for a phone
    there = {section for section in SECTIONS if f'id="{section}"' in page}
    assert there == {*SECTIONS} - {"worlds", *FURTHER}
    text = (out / "report.md").read_text()
    for picture in re.findall(r"]\((figures/[^)]*)\)", text):
        assert (out / picture).is_file()
    assert "](figures/curves-dqn-reward.png)" in text


def test_a_place_that_cannot_be_written_is_answered_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("uavnav.report.content.gather", lambda folders: pytest.fail("it was read"))
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(RunError, match="cannot be written"):
            report([tmp_path], out)


def test_the_tables_are_csv_that_say_what_the_content_says(whole):
    _, gathered, written = whole
    folder = written.path.parent / "tables"
    assert {file.stem for file in folder.glob("*.csv")} == {*gathered.tables}
    metrics = pd.read_csv(folder / "metrics.csv")
    row = (
        metrics[metrics["activation"] == "tanh"].set_index(["algorithm", "definition", "metric"]).sort_index()
    )
    assert row.loc["dqn", TOTALS, "speed"]["mean"] == 7
    assert row.loc["ppo", ALL, "reward"]["mean"] == -7
    assert row.loc["ppo", PRIMARY, "reward"][["mean", "paper"]].tolist() == pytest.approx([-0.014, 0.0324563])
    behaviour = pd.read_csv(folder / "behaviour.csv").set_index(["configuration", "seed"])
    first, second = layouts.load("test")[:2].tolist()
    ahead = [min(math.hypot(x - 400, y - 300 - 9 * n) - r for x, y, r in first) for n in range(1, 6)]
    around = min(math.hypot(x - 400, y - 300) - r for x, y, r in second)
    assert behaviour["clearance"].tolist() == pytest.approx([np.mean(ahead), around] * 3, rel=1e-5)
    assert behaviour["reversals"].tolist() == [0] * 6
    assert behaviour["empty_straight_speed"].tolist() == [9] * 6
    overestimated = pd.read_csv(folder / "overestimation.csv")
    assert overestimated["q"].tolist() == pytest.approx([50, 50])


def test_no_warning_escapes_a_report_on_one_seed(tmp_path):  # nor one on few and equal seeds, see `whole`
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_run(tmp_path / "open", rows(0, (1000, 10, 0, 0, 0, 0, -1.0, False, False)))
        assert report([tmp_path]).path.is_file()


def test_a_persons_episodes_and_a_policy_from_elsewhere_are_rows_of_all_six_metrics_on_page_and_in_report_md(
    results, undrawn
):
    flown = rows(0, (100, 100, 10, 0, 50, 400, -6.0), (200, 100, 0, 0, 10, 600, -4.0))
    (results / "baselines").mkdir()
    for who in ("human", "theirs-sampled"):
        flown.to_parquet(results / "baselines" / f"{who}.parquet")
    report([results])
    text = (results / "report.md").read_text()
    for who in ("human", "theirs-sampled"):
        *_, row, _ = found(text, who)  # after that of survival, before that of gaps to the rule
        seeds, episodes, cut, steps, *_, speed, reward = row
        assert (seeds, episodes, cut, steps, speed, reward) == ("1", "2", "0.0%", "100.0", "5.00", "−5.00")
        assert f">{who}<" in (results / "report.html").read_text()


# -- a third algorithm ---------------------------------------------------------------------------------------


def test_a_third_algorithm_leaves_the_claims_as_they_are(whole, undrawn):
    path, with_it, _ = whole
    without = gather([path / name for name in ("dqn", "ppo", "short")])
    assert with_it.tables["verdicts"].equals(without.tables["verdicts"])
    assert with_it.missing == without.missing
    assert {*SECTIONS} - {*dict(sections(without))} == {"algorithms", "worlds", *FURTHER}


def test_a_third_algorithm_has_its_configurations_and_tables_behind_the_papers(whole):
    _, content, written = whole
    out = written.path.parent
    assert [*content.studies.main] == [("dqn", "tanh"), ("ppo", "tanh"), ("a2c", "tanh"), ("a2c", "relu")]
    assert {*content.tables["metrics"]["algorithm"]} == {"dqn", "ppo", "a2c"}
    assert {"A2C tanh", "A2C: tanh and relu"} <= {
        *content.tables["speed"]["configuration"],
        *content.tables["power"]["pair"],
    }
    assert {*content.tables["behaviour"]["configuration"]} == {"DQN tanh", "PPO tanh", "A2C tanh"}
    text = (out / "report.md").read_text()
    assert re.findall("^## (DQN|PPO|A2C)$", text, re.MULTILINE) == ["DQN", "PPO", "A2C"]
    assert len(found(text, "tanh", PRIMARY)) == 3
    page = (out / "report.html").read_text()
    for caption in ("Table 1: DQN", "Table 2: PPO", "A2C"):
        assert f"<caption>{caption}</caption>" in page


def test_a_third_algorithm_has_its_figures_and_replays(whole):
    _, content, _ = whole
    drawn = {figure.name: figure for figure in content.figures}
    assert "as the paper's" not in drawn["curves-a2c-reward"].caption
    assert drawn["curves-ppo-reward"].caption.startswith("PPO, as the paper's Figure 5: reward")
    assert "the paper's mean -6.98" in drawn["curves-dqn-reward"].drawn.alt
    for name in ("configurations-reward", "trajectories", "heat", "survival"):
        assert "A2C" in drawn[name].drawn.alt, name
    shown = {
        configuration["algorithm"]: configuration["values"]
        for configuration in content.replays["configurations"]
    }
    assert shown == {"dqn": "Q value", "ppo": "probability", "a2c": "probability"}
    assert {*content.tables["overestimation"]["configuration"]} == {"DQN tanh"}
