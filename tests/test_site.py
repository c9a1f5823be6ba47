"""The site builds, and what its pages show runs: commands one after the other, snippets as they are."""

import functools
import importlib
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import yaml
from browsing import NARROW, resize, violations
from pages import ALL, DOCS, MINE, PAGES, ROOT, blocks

import uavnav
from uavnav import evaluation, networks, plugins
from uavnav.__main__ import main
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.report import compare
from uavnav.runs import metrics
from uavnav.runs.evaluations import Protocol
from uavnav.tasks import rewards, table
from uavnav.training import machine

NAVIGATION = (ROOT / "mkdocs.yml").read_text()

# -- the site ------------------------------------------------------------------------------------------------


def build(folder):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "site")]
    offline = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    environment = {**os.environ, **offline, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr  # --quiet would not count warnings


@pytest.fixture(scope="module")
def site(once):
    if any(find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings", "latex2mathml")):
        pytest.skip("mkdocs is not installed: pip install -e '.[docs]'")
    folder = once("site", build) / "site"
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*.html")}


def test_every_page_is_built_and_every_module_of_the_api_has_content(site):
    assert {
        str(Path(name).relative_to("docs").with_suffix(".html")) for name in ALL if name != "README.md"
    } <= {*site}
    for name, word in {
        "layouts": "load",
        "moving": "motion",
        "env": "DroneEnv",
        "stats": "holm",
        "report": "Written",
    }.items():
        assert f'id="{uavnav.HOMES.get(name, f"uavnav.{name}")}.{word}"' in site[f"api/{name}.html"]


SHORT = {"compare", "playground"}
"""Known without their folder, and without a page."""


def test_every_module_that_uavnav_offers_has_a_page_of_the_api_in_the_navigation():
    (shown,) = [one["API"] for one in yaml.load(NAVIGATION, yaml.BaseLoader)["nav"] if "API" in one]
    assert {*uavnav._MODULES, *uavnav.HOMES} - SHORT == {name for page in shown for name in page}
    assert all(page == {name: f"api/{name}.md"} for page in shown for name in page)


@pytest.mark.parametrize("notebook", sorted((DOCS / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_a_page_of_all_its_headings_and_code_cells(site, notebook):
    page = site[f"notebooks/{notebook.stem}.html"]
    cells = json.loads(notebook.read_text())["cells"]
    titles = [line for cell in cells for line in cell["source"] if line.startswith(("# ", "## "))]
    assert len(re.findall(r"<h[12] id=", page)) == len(titles)
    assert len(re.findall(r'<div class="language-python highlight"', page)) == len(
        [cell for cell in cells if cell["cell_type"] == "code"]
    )
    assert f"notebooks/{notebook.stem}.md" in NAVIGATION
    assert ".ipynb" not in re.sub(r"<code>docs/notebooks/[\w-]+\.ipynb</code>", "", page)


def test_the_playground_of_the_committed_runs_is_a_page_and_two_pages_lead_to_it(site):
    assert "const playground = new Playground(" in site["fly.html"]
    assert site["fly.html"].count('"key":') == 24
    for name in ("index.html", "playground.html"):
        assert re.search(r'<a href="?fly\.html"?>Fly it here</a>', site[name]), name


def test_the_front_page_is_the_reports_first_screen_and_its_number_leads_to_the_row(site):
    report = (ROOT / "results" / "report.html").read_text()
    screen = "".join(re.findall(r"(?s)<!-- first -->(.*?)<!-- end of first -->", report))
    sentence = re.search(r"<h1>(.*?)<a ", screen)[1]
    assert sentence in site["index.html"]
    assert site["index.html"].count("<li>PPO") == screen.count("<li>PPO") == 2
    assert site["index.html"].count("the paper, 1 run</th>") == screen.count("the paper, 1 run</th>") == 1
    assert site["index.html"].count("<canvas role") == report.count("<canvas role") == 3
    assert 'new Together(document.getElementById("together")' in site["index.html"]
    row = re.search(r'href="?report/report\.html#(row-verdicts-\d+)', site["index.html"])[1]
    assert f'id="{row}"' in report
    assert re.search(r'href="?report/report\.html#row-verdicts-\d+', site["results.html"])
    link = "../docs/limitations.md", "../limitations.html"
    assert report.count(link[0]) == 1
    assert site["report/report.html"] == report.replace(*link)
    assert Path(link[1]).name in site
    assert re.search(r'href="?report/report\.html"?>the report as one page', site["results.html"])
    pictures = (ROOT / "docs" / "results.md").read_text().count("![")
    assert len(re.findall(r'src="?report/figures/', site["results.html"])) == pictures > 1


def test_every_page_tells_whom_it_is_sent_to_what_it_is(site):
    for name, page in site.items():
        if name not in ("fly.html", "404.html"):
            told = dict(re.findall(r'<meta (?:property|name)="((?:og|twitter):\w+)" content="([^"]+)"', page))
            assert {*told} >= {"og:title", "og:description", "og:image", "twitter:card"}, name
            assert told["og:image"].endswith("preview.png")
    # 1200 x 630
    assert (ROOT / "results" / "preview.png").read_bytes()[16:24] == bytes.fromhex("000004b000000276")


@pytest.fixture(scope="module")
def addresses(site, once):
    """Of the pages that have no browser's test of their own, by name."""
    others = {"fly.html", "404.html", "report/report.html"}
    folder = once("site", build) / "site"
    return {name: (folder / name).as_uri() for name in site.keys() - others if not name.startswith("api/")}


@pytest.mark.slow
def test_each_page_is_whole_at_390_px(chrome, addresses):
    resize(chrome, NARROW, 844)
    for name, address in addresses.items():
        chrome.get(address)
        assert chrome.execute_script("return document.documentElement.scrollWidth") <= NARROW, name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["start", "extending", "studies", "sac", "results", "notebooks/4-your-own"])
def test_axe_finds_nothing_serious_on_pages_of_each_kind_in_light_and_dark(chrome, addresses, name):
    resize(chrome, NARROW, 844)
    chrome.get(addresses[f"{name}.html"])
    for colours in ("default", "slate"):
        shown = "document.body.setAttribute('data-md-color-scheme', arguments[0]);"
        shown += (
            "return Promise.all(document.getAnimations().map(({ finished }) => finished)).then(() => true)"
        )
        assert chrome.execute_script(shown, colours)  # colours change slowly
        assert violations(chrome, "serious", "critical") == [], colours


def test_no_page_loads_anything_from_the_network(site):
    for name, page in site.items():
        loaded = re.findall(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?([^\s\">]+)", page)
        loaded += re.findall(r"<link\b[^>]*\bhref=\"?([^\s\">]+)", page)
        assert loaded
        assert not [one for one in loaded if re.match(r"(https?:)?//", one)], name


def test_every_equation_is_mathml(site):
    for name, least in {
        "environment.html": 30,
        "ppo.html": 10,
        "dqn.html": 8,
        "a2c.html": 6,
        "c51.html": 8,
        "sac.html": 6,
        "pqn.html": 4,
    }.items():
        assert site[name].count("<math") >= least
    for name, page in site.items():
        assert "arithmatex" not in page, name
        assert not re.search(r"<mi>(&amp;|&<|\\)", page), f"{name}: TeX that latex2mathml does not know"


def test_a_list_that_a_sentence_interrupts_goes_on_at_its_number(site):
    assert [f'<ol start="{first}"' in site["sac.html"] for first in (10, 13, 14)] == [True, True, False]


def test_links_to_files_that_are_no_pages_are_their_paths(site):
    assert "uavnav/tasks/world.py</code>" in site["environment.html"]
    assert not [
        name
        for name, page in site.items()
        if re.search(r'href="?(\.\./)+(uavnav/|results/|tests/|README|CONTRIBUTING)', page)
    ]


def test_the_hook_tells_of_a_file_that_is_missing(monkeypatch):
    pytest.importorskip("latex2mathml")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    told = []  # mkdocs rearranges the logging of a process
    monkeypatch.setattr(hooks.log, "warning", lambda line, *words: told.append(line % words))

    class Here:
        src_uri = "page.md"
        config_file_path = str(ROOT / "mkdocs.yml")
        file = property(lambda self: self)

    def shown(text):
        return hooks.on_page_markdown(text, page=Here(), config=Here())

    assert shown("see [the module](../uavnav/graph.py)") == "see the module (`uavnav/graph.py`)"
    assert shown("see [`uavnav/graph.py`](../uavnav/graph.py)") == "see `uavnav/graph.py`"
    assert shown("see [PPO](../docs/ppo.md)") == "see [PPO](../docs/ppo.md)"
    assert shown("by [5 (4 to 6)](../results/tables/gaps.csv#L2) less") == "by 5 (4 to 6) less"
    assert shown("see [the\nmodule](../uavnav/graph.py)") == "see the\nmodule (`uavnav/graph.py`)"
    assert shown("[a](../results/report.html#verdicts)") == "[a](report/report.html#verdicts)"
    assert shown("[a part](../results/report.md#why)") == "a part (`results/report.md`)"
    assert not told
    shown("see [nothing](../uavnav/nothing.py)")
    assert told == ["page.md links to uavnav/nothing.py, which is not in the repository"]


# -- commands ------------------------------------------------------------------------------------------------

COMMANDS = [
    (name, line.partition(" #")[0].strip())
    for name, page in ALL.items()
    for block in blocks(page, "console")
    for line in block.replace("\\\n", " ").splitlines()
    if line.strip() and not line.startswith("#")
]
EXEMPT = {
    "python3.11 -m venv .venv": "a fresh environment: .ci/run makes one",
    "source .venv/bin/activate": "changes the reader's own shell",
    "pip install -e .": "needs a package index: .ci/run installs",
}
"""Commands that are not run, and why."""


def as_uavnav(words):
    """`python recipes/ppo.py ...` as `uavnav train ppo ...`."""
    recipe = re.fullmatch(r"recipes/(\w+)\.py", words[1]) if words[0] == "python" and len(words) > 1 else None
    return ["uavnav", "train", recipe[1], *words[2:]] if recipe else words


def test_every_make_target_and_every_extra_that_a_page_shows_exists():
    """The other commands run, see below."""
    targets = re.findall(r"^([\w -]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for _, command in COMMANDS:
        words = shlex.split(command)
        if words[0] == "make":
            assert words[1] in " ".join(targets).split()
        elif words[:2] == ["pip", "install"]:
            assert {*re.findall(r"\[(.*)\]", command)} <= {*extras}


def test_every_command_of_uavnav_that_a_page_shows_is_parsed():
    of_uavnav = [
        words[1:] for _, command in COMMANDS if (words := as_uavnav(shlex.split(command)))[0] == "uavnav"
    ]
    assert len(of_uavnav) >= 50
    for name, *words in filter(None, of_uavnav):
        commands.parse(name, words)


TINY = {
    "train ppo": ["n_envs=64", "total_frames=2048", "epochs=1", "compile=off", "evaluate=false"],
    "train a2c": ["n_envs=64", "total_frames=2048", "compile=off", "evaluate=false"],
    "train c51": ["n_envs=64", "total_frames=2048", "learning_starts=1984", "compile=off", "evaluate=false"],
    "train dqn": ["n_envs=64", "total_frames=2048", "learning_starts=1984", "compile=off", "evaluate=false"],
    "train pqn": ["n_envs=64", "total_frames=2048", "epochs=1", "compile=off", "evaluate=false"],
    "train sac": ["n_envs=64", "total_frames=2048", "learning_starts=1984", "compile=off", "evaluate=false"],
    "evaluate": ["--episodes", "2", "--max-steps", "20"],
    "render": ["--steps", "20"],
    "study": ["--status"],
}
"""What is added to a line, so that it takes a second or two; a study only says what it would train."""


@pytest.fixture
def carry_out(tmp_path, monkeypatch, undrawn):
    """Runs a line in an empty folder, in this process, with tiny settings and no browser: its status."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(machine, "cores", lambda: 1)  # no further processes
    # of its own episodes, and where a run has none
    monkeypatch.setattr(compare, "Protocol", functools.partial(Protocol, episodes=2, max_steps=20))
    evaluate = evaluation.evaluate_run

    def few(run, *given, **how):
        return evaluate(run, *(given or (2, 20)), **how)

    monkeypatch.setattr(evaluation, "evaluate_run", few)

    def run(command):
        if command == "make train":
            (command,) = re.findall(
                r"^train:.*\n\t@.*\n\t\$\(BIN\)/(.*)", (ROOT / "Makefile").read_text(), re.MULTILINE
            )
        program, *words = as_uavnav(shlex.split(command))
        assert program == "uavnav"
        tiny = TINY.get(" ".join(words[:2])) or TINY.get(words[0], []) if words else []
        if words[:1] == ["train"] and not any(word.startswith("out=") or word == "-m" for word in words):
            # the folder that the line as it stands would have
            given = dict(word.split("=") for word in words[2:])
            named = {key: given[key] for key in ("preset", "activation") if key in given}
            tiny = [*tiny, f"out={ALGORITHMS[words[1]].config(**named).folder}"]
        return main([*(re.sub(r"^n_seeds=\d+$", "n_seeds=2", word) for word in words), *tiny])

    return run


def untrained_zip(path):
    sb3 = pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    sb3.PPO("MlpPolicy", DroneVecEnv(num_envs=2), n_steps=8, batch_size=16, device="cpu").save(path)


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("page", sorted({page for page, _ in COMMANDS}))
def test_the_commands_of_a_page_run_one_after_the_other(page, carry_out, tmp_path, monkeypatch, capfd):
    for name in ("av", "onnxscript", "tensorboard"):
        pytest.importorskip(name)
    lines = [command for where, command in COMMANDS if where == page]
    if any("theirs.zip" in command for command in lines):
        untrained_zip(tmp_path / "theirs.zip")
    if any("my_activation" in command for command in lines):
        (tmp_path / "my_activation.py").write_text(blocks(ALL[page], "python")[0])
        monkeypatch.setitem(networks.ACTIVATIONS, "cube", torch.sign)  # taken back at the end
        monkeypatch.setattr(plugins, "LOADED", dict(plugins.LOADED))
        tables = {name: (table, dict(known)) for name, (table, known) in plugins.TABLES.items()}
        monkeypatch.setattr(plugins, "TABLES", tables)
    for command in lines:
        targets = command.startswith("make ") and command != "make train"  # hours, minutes, or this suite
        if not targets and command not in EXEMPT:
            assert carry_out(command) == 0, command
            assert "arning" not in capfd.readouterr().err, command
            for named in re.findall(r"(?:--out |\bout=)([^\s$]+)", command) * ("uavnav study" not in command):
                assert (tmp_path / named).exists(), command


# -- snippets ------------------------------------------------------------------------------------------------


ADDED = ("cube", "gentle", "slow", "bend", "squares")
"""What the snippets add to the tables of the package."""


@pytest.mark.parametrize("name", MINE)
def test_the_snippets_of_a_page_run_one_after_the_other(name, tmp_path, monkeypatch):
    snippets = blocks(PAGES[name], "python")
    assert snippets
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for added_to in (networks.ACTIVATIONS, rewards.REWARDS, metrics.METRICS, table.TASKS, ALGORITHMS):
        for added in ADDED:
            # taken back at the end, whatever snippets do
            monkeypatch.setitem(added_to, added, ALGORITHMS["ppo"])
            del added_to[added]
    names: dict = {}
    for snippet in snippets:
        exec(compile(snippet, f"docs/{name}.md", "exec"), names)


def test_rows_of_a_callable_in_baselines_are_a_column_of_the_report_under_the_files_name(tmp_path):
    frames = importlib.import_module("uavnav.report.frames")
    rows = uavnav.evaluate_policy(
        lambda observation, generator: torch.full([len(observation)], 9), episodes=3
    )
    (tmp_path / "baselines").mkdir()
    rows.to_parquet(tmp_path / "baselines" / "mine.parquet")
    found, unread = frames.baselines([tmp_path])
    assert {name: len(table) for name, table in found.items()} == {"mine": 3}
    assert not unread
    assert 'same.to_parquet("runs/baselines/mine.parquet")' in ALL["docs/bridges.md"]
