"""What is committed of results: report, conclusions and the tables of the docs are what the rows of the runs
say.

And how the rule of verdicts fares where seeds scatter as those of the rows do.
"""

import functools
import io
import itertools
import json
import re
from collections import defaultdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import load_file
from tied import LINK, first_screen, too_long, untied

from uavnav import stats
from uavnav.report.claims import EVERY
from uavnav.report.content import gather
from uavnav.report.docs import BLOCKS, block, results
from uavnav.report.operating import EQUAL, TABLES, characteristics
from uavnav.report.page import markdown
from uavnav.report.studies import of_paper
from uavnav.runs import Run, paper
from uavnav.runs.definitions import PER_FRAME, per_frame

ROOT = Path(__file__).parent.parent
BEGIN, END = "<!-- results -->", "<!-- end of results -->"
RESULTS = ROOT / "results"


@pytest.mark.parametrize(("folder", "seeds"), [("vectorised", range(20)), ("paper", range(100, 140))])
@pytest.mark.parametrize(("algorithm", "activation"), paper.TABLES)
def test_each_configuration_has_its_seeds_of_a_million_frames_of_a_preset_and_was_evaluated_on_200_sets(
    algorithm, activation, folder, seeds
):
    run = Run(RESULTS / folder / algorithm / activation)
    assert run.seeds == list(seeds)
    assert run.frames >= 1_000_000
    assert run.meta["beyond_preset"] == {}
    assert len(run.meta["git_commit"]) == 40  # and no + of changes that were not committed
    assert run.evaluation().groupby(["mode", "seed"]).layout.nunique().tolist() == [200] * 2 * len(seeds)


def test_all_that_is_committed_of_results_takes_less_than_100_mb():
    assert sum(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < 100e6


def test_rows_and_weights_are_those_that_the_runs_wrote_before_the_folders_were_put_in_order():
    """Checksums of each column of each table, and of each tensor, from the old files as read, under their
    new names.
    """
    found: dict[str, Any] = defaultdict(sha256)

    def note(path: Path, name: str, values: np.ndarray) -> None:
        place = path.relative_to(RESULTS)
        kind = f"{place.parts[0]} {re.split('[-.]', place.name)[0]}"
        content = "\n".join(map(str, values)).encode() if values.dtype == object else values.tobytes()
        found[kind].update(f"{place} {name} {values.dtype} {values.shape}\n".encode() + content)

    for path in sorted(RESULTS.rglob("*.parquet")):
        for name, column in pd.read_parquet(path).items():
            note(path, name, column.to_numpy())
    for path in sorted(RESULTS.rglob("policy.safetensors")):
        for name, tensor in sorted(load_file(path).items()):
            note(path, name, tensor)
    sums = json.loads((ROOT / "tests" / "results.json").read_text())
    assert {kind: one.hexdigest() for kind, one in found.items()} == sums


README = (ROOT / "README.md").read_text().partition(BEGIN)[2].partition(END)[0]
CONCLUSIONS = {"README": README, "docs/results.md": (ROOT / "docs" / "results.md").read_text()}
RATIOS = [
    paper.TABLES["ppo", "tanh"][name] / paper.TABLES["ppo", "relu"][name] for name in ("steps", "distance")
]


@pytest.mark.parametrize("name", CONCLUSIONS)
def test_each_number_of_the_conclusions_is_in_the_row_of_tables_that_its_line_links_to(name):
    text = CONCLUSIONS[name]
    known = [f"{ratio:.2f}" for ratio in RATIOS]  # which a note on claim 2 says of the paper
    claims = [number for claim in EVERY for number in re.findall(r"[\d,]+", claim.sentence)]
    assert len(LINK.findall(text)) >= 20
    assert {
        line: off
        for line in text.splitlines()
        if (off := untied(TALLY.sub("", line), RESULTS, [*known, *claims, *NUMBERS]))
    } == {}


@pytest.mark.parametrize(
    ("page", "least"),
    [
        ("limitations", 10),
        ("decisions", 20),
        ("algorithms", 10),
        ("learned-or-classical", 20),
        ("c51", 2),
        ("sac", 1),
    ],
)
def test_each_number_that_a_page_links_is_in_its_row_of_the_tables(page, least):
    links = [found[0] for found in LINK.finditer((ROOT / "docs" / f"{page}.md").read_text())]
    assert len(links) >= least
    assert {link: off for link in links if (off := untied(link, RESULTS))} == {}


TALLY = re.compile(r"\(\d+ of \d+\)")  # of a claim's parts: many rows
NUMBERS = [str(claim.number) for claim in EVERY]
NUMBERS += ["0", "46", "200", "2,000", "10,000", "100,000", "500,000"]
"""Of claims, of settings, and of how many there are, which no row holds."""


def test_a_number_that_is_off_by_one_in_its_last_place_is_found():
    line = next(line for line in README.splitlines() if line.startswith("- PPO"))
    ((shown, *_),) = LINK.findall(line)
    number = re.match(r"[\d,.]+", shown)[0]
    digit = str((int(number[-1]) + 1) % 10)
    assert untied(line.replace(shown, shown.replace(number, number[:-1] + digit, 1)), RESULTS) != []


@pytest.mark.parametrize("name", CONCLUSIONS)
def test_the_conclusions_have_no_sentence_of_more_than_25_words_and_no_commit(name):
    assert too_long(CONCLUSIONS[name]) == []
    assert not re.search(r"\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b", CONCLUSIONS[name])


def test_the_committed_pages_first_screen_has_no_sentence_of_more_than_25_words_and_no_commit():
    shown = first_screen((RESULTS / "report.html").read_text())
    assert len(shown) > 30
    assert [one for part in shown for one in too_long(part)] == []
    assert not re.search(r"\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,40}\b", " ".join(shown))


def test_every_link_and_picture_of_the_committed_report_is_there():
    page, text = ((RESULTS / f"report.{kind}").read_text() for kind in ("html", "md"))
    anchors = set(re.findall(r'\bid="([^"]+)"', page))
    linked = re.findall(r'href="([^"]+)"', page.partition("<script")[0])
    linked += re.findall(r"\]\(([^)\s]+)\)", text)
    assert len(linked) > 40
    for target in linked:
        path, _, anchor = target.partition("#")
        if not path:
            assert anchor in anchors, target
        elif not path.startswith("data:"):
            assert (RESULTS / path).is_file(), target
            assert not anchor or int(anchor[1:]) <= len((RESULTS / path).read_text().splitlines()), target
    headings = {
        re.sub(r"[^\w -]", "", one.lower()).replace(" ", "-") for one in re.findall(r"^#+ (.*)$", text, re.M)
    }
    for anchor in re.findall(
        r"report\.md#([\w-]+)", "".join(path.read_text() for path in ROOT.glob("docs/*.md"))
    ):
        assert anchor in headings
    drawn = {path.stem for path in (RESULTS / "figures").iterdir()}
    assert drawn == set(re.findall(r'id="figure-([\w-]+)"', page))


def test_the_differences_that_the_decisions_quote_are_those_of_the_tables():
    text = " ".join(LINK.sub(r"\1", (ROOT / "docs" / "decisions.md").read_text()).split())
    table = pd.read_csv(RESULTS / "tables" / "sensitivity.csv").set_index(["switch", "conclusion"])
    lead, order = "PPO above DQN", "DQN: tanh above ReLU"
    for key in (("default", lead), ("n_steps=5", lead), ("default", order), ("init=orthogonal", order)):
        value, low, high = (
            f"{end:.4f}".replace("-", "−") for end in table.loc[key, ["value", "low", "high"]]
        )
        assert f"{value} [{low}, {high}]" in text, key
    assert table.xs(lead, level=1)["low"].min() > 0
    within_ppo = table.xs("PPO: tanh above ReLU", level=1)
    assert (within_ppo["low"] * within_ppo["high"] < 0).all()
    assert [*table[table["flips"] == "yes"].index] == [("init=orthogonal", order)]
    for _, one in pd.read_csv(RESULTS / "tables" / "by_default.csv").head(2).iterrows():
        assert f"{one['value']:.0f} [{one['low']:.0f}, {one['high']:.0f}]" in text


def test_the_counts_of_the_papers_numbers_that_the_decisions_quote_are_those_of_the_tables():
    text = " ".join(LINK.sub(r"\1", (ROOT / "docs" / "decisions.md").read_text()).split())
    fits = (
        pd.read_csv(RESULTS / "tables" / "fits.csv")
        .set_index(["definition", "configuration"])["within"]
        .unstack("configuration")
    )
    of_log, everything = fits.loc["log curve"], fits["all configurations"]
    of_each = [int(of_log.filter(like=algorithm).sum()) for algorithm in ("DQN", "PPO")]
    said = "{} of 48 numbers are inside: {} of DQN's 24 and {} of PPO's".format(
        of_log["all configurations"], *of_each
    )
    assert said in text
    definitions = "per frame", "all training episodes", "last 100 training episodes", "sampled evaluation"
    said = (
        "Per frame {} are inside, and over all training episodes {}. Wider intervals contain more: "
        "{} over the last 100 episodes, and {} in sampled test episodes."
    )
    assert said.format(*(everything[name] for name in definitions)) in text


@pytest.fixture(scope="module")
def seeds():
    """The study in many environments per seed, per frame: a row a seed."""
    runs = {
        configuration: Run(RESULTS / "vectorised" / Path(*configuration)) for configuration in paper.TABLES
    }
    return {configuration: per_frame(run.episodes, run.frames) for configuration, run in runs.items()}


@pytest.mark.parametrize("n", [5, 10, 20, 40])
def test_welchs_interval_covers_94_percent_where_seeds_scatter_as_ours_and_percentiles_of_5_fewer_than_87(
    seeds, n
):
    """Of a difference of two activations, mean over pairs and metrics; the truth are our 20 seeds."""
    rng = np.random.default_rng(n)
    welch, percentiles = [], []
    for metric, algorithm in itertools.product(paper.COLUMNS, paper.TABLE_OF):
        configurations = [seeds[algorithm, activation][metric].to_numpy() for activation in paper.ACTIVATIONS]
        for pair in itertools.combinations(
            [configuration - configuration.mean() for configuration in configurations], 2
        ):
            drawn = [one[rng.integers(len(one), size=(500, n))] for one in pair]
            found = stats.welch(drawn, np.array([[1, -1]]))
            welch.append(np.mean((found.lower(0.025) <= 0) & (found.upper(0.025) >= 0)))
            if n == 5:
                again = [
                    one[np.arange(500)[:, None, None], rng.integers(n, size=(500, 200, n))] for one in drawn
                ]
                low, high = np.quantile(again[0].mean(-1) - again[1].mean(-1), [0.025, 0.975], axis=1)
                percentiles.append(np.mean((low <= 0) & (high >= 0)))
    assert np.mean(welch) >= 0.94
    assert n != 5 or np.mean(percentiles) < 0.87


def test_the_rule_finds_the_papers_tables_if_they_are_true_and_nothing_where_nothing_differs(seeds):
    """Claim 5's effect of 0.04 % is too small for 20 seeds, whatever is true."""

    def evidence(algorithm, activation, metric, study="main"):
        table = seeds[algorithm, activation]
        return table[metric].to_numpy() if study == "main" and metric in table else np.empty(0)

    table = characteristics(evidence, functools.partial(of_paper, definition=PER_FRAME))
    shares = table.set_index(["claim", "truth", "grade"])["share"].sort_index()
    for claim in (1, 2, 3, 6, 7, 8):
        assert shares[claim, TABLES, "replicates"] > 0.9, claim
        assert shares[claim, TABLES, "does not"] < 0.01, claim
        assert sum(shares[claim, EQUAL]) == pytest.approx(1)
        assert shares[claim, EQUAL, "replicates"] <= 0.05, claim
        assert shares[claim, EQUAL, "does not"] > 0.9, claim
    assert shares[5, TABLES, "open"] == shares[5, EQUAL, "open"] == 1


def from_rows(text):
    return [line for line in text.splitlines() if line and line[0] != "!"]


@pytest.mark.slow
def test_the_committed_report_conclusions_and_tables_are_what_the_rows_give(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("uavnav.report.figures.draw", lambda *anything: [])
    content = gather([Path("results")], lambda configurations: {"configurations": [], "left_out": []})
    assert from_rows(markdown(content)) == from_rows((RESULTS / "report.md").read_text())
    assert from_rows(results(content)) == from_rows((ROOT / "docs" / "results.md").read_text())
    for page in BLOCKS:
        if page != "docs/algorithms.md":  # which has times and memory of another file
            _, _, rest = (ROOT / page).read_text().partition(BEGIN)
            assert from_rows(rest.partition(END)[0]) == from_rows(block(content, page)), page
    assert {path.stem for path in (RESULTS / "tables").glob("*.csv")} == content.tables.keys()
    for name, table in content.tables.items():
        committed = pd.read_csv(RESULTS / "tables" / f"{name}.csv")
        again = pd.read_csv(io.StringIO(table.to_csv(index=False, float_format="%.6g")))
        assert list(committed.columns) == list(again.columns)
        pd.testing.assert_frame_equal(committed, again, rtol=1e-5)
        numbers = again.select_dtypes(np.number)
        assert not numbers.empty or again.empty, name
