"""The pages of docs/ hold what they show: the site builds, commands and snippets run, tables are the code's."""

import argparse
import ast
import dataclasses
import importlib
import importlib.util
import inspect
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import pytest
import torch
import yaml

import uavnav
from uavnav import networks, runs
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.report import frames
from uavnav.runs import metrics
from uavnav.tasks import rewards
from uavnav.tasks.simulator import Outcome, State
from uavnav.tasks.world import World
from uavnav.training import machine
from uavnav.training.config import SWITCHES
from uavnav.window import play

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
NAVIGATION = (ROOT / "mkdocs.yml").read_text()
ALL = {str(path.relative_to(ROOT)): path.read_text() for path in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]}
MINE = ("start", "world", "ppo", "dqn", "extending")
PAGES = {name: ALL[f"docs/{name}.md"] for name in (*MINE, "troubleshooting")}
CONFIGS = {"ppo": PPOConfig, "dqn": DQNConfig}
CLASSES = {one.__name__: one for one in (World, State, Outcome, PPOConfig, DQNConfig)}


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def table(page, header):
    """The rows of the first table with this header, as lists of cells."""
    rest = page.split(f"\n{header}\n", 1)[1]
    lines = rest.split("\n\n", 1)[0].splitlines()[1:]
    return [[cell.strip() for cell in line.strip("|").split(" |")] for line in lines]


def code(cell):
    return re.findall(r"`([^`]+)`", cell)


def written(value):
    """A default as the tables write it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:_}" if value >= 10_000 else str(value)
    return str(value)


# -- the site ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if any(find_spec(name) is None for name in ("mkdocs", "material", "mkdocstrings", "latex2mathml")):
        pytest.skip("mkdocs is not installed: pip install -e '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    offline = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    environment = {**os.environ, **offline, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr  # --quiet would not count warnings
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*.html")}


def test_every_page_is_built_and_every_module_of_the_api_has_content(site):
    assert {str(Path(name).relative_to("docs").with_suffix(".html")) for name in ALL if name != "README.md"} <= {*site}
    for name, word in {"layouts": "generate", "env": "DroneEnv", "stats": "holm", "report": "Written"}.items():
        assert f'id="{uavnav.HOMES.get(name, f"uavnav.{name}")}.{word}"' in site[f"api/{name}.html"]


def test_every_module_that_uavnav_offers_has_a_page_of_the_api_in_the_navigation():
    (shown,) = [one["API"] for one in yaml.load(NAVIGATION, yaml.BaseLoader)["nav"] if "API" in one]
    assert {*uavnav._MODULES, *uavnav.HOMES} - {"play"} == {name for page in shown for name in page}
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


def test_no_page_loads_anything_from_the_network(site):
    for name, page in site.items():
        loaded = re.findall(r"<(?:script|img|iframe|source)\b[^>]*\bsrc=\"?([^\s\">]+)", page)
        loaded += re.findall(r"<link\b[^>]*\bhref=\"?([^\s\">]+)", page)
        assert loaded
        assert not [one for one in loaded if re.match(r"(https?:)?//", one)], name


def test_every_equation_is_mathml(site):
    for name, least in {"world.html": 30, "ppo.html": 10, "dqn.html": 8}.items():
        assert site[name].count("<math") >= least
    for name, page in site.items():
        assert "arithmatex" not in page, name
        assert not re.search(r"<mi>(&amp;|&<|\\)", page), f"{name}: TeX that latex2mathml does not know"


def test_links_to_files_that_are_no_pages_are_their_paths(site):
    assert "uavnav/tasks/world.py</code>" in site["world.html"]
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
    told = []  # Hydra and mkdocs both rearrange the logging of a process
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
    assert not told
    shown("see [nothing](../uavnav/nothing.py)")
    assert told == ["page.md links to uavnav/nothing.py, which is not in the repository"]


# -- commands ---------------------------------------------------------------------------------------------------------

COMMANDS = [
    (name, line.partition(" #")[0].strip())
    for name, page in ALL.items()
    for block in blocks(page, "console")
    for line in block.replace("\\\n", " ").splitlines()
    if line.strip() and not line.startswith("#")
]
EXEMPT = {
    "make test": "this suite: .ci/run begins with it",
    "make study": "hours: one of its recipes is run in each page",
    "make initial": "hours",
    "make tuned": "an hour",
    "make sensitivity": "hours",
    "make wide": "hours",
    "make report": "minutes, on what the hours gave: tests/test_results.py and tests/test_report.py",
    "python3.11 -m venv .venv": "a fresh environment: .ci/run makes one",
    "source .venv/bin/activate": "changes the reader's own shell",
    "pip install -e '.[play]'": "needs a package index: .ci/run installs",
}
"""Commands that are understood and not run, and why."""


def home(module):
    """Where the `main` of `python -m module` is."""
    return f"{module}.__main__" if find_spec(module).submodule_search_locations else module


class Parsed(BaseException):
    """The arguments were understood."""


def parse_recipe(words):
    """Every combination of a sweep is a configuration, and the other keys are the recipe's own."""
    recipe = ROOT / words[0]
    own = set(yaml.safe_load((ROOT / "recipes/conf" / f"{recipe.stem}.yaml").read_text())) - {"defaults", "hydra"}
    given = [word.partition("=")[::2] for word in words[1:] if word != "-m"]
    names = {field.name for field in dataclasses.fields(CONFIGS[recipe.stem])}
    for key, _ in given:
        assert key in own | names, key
    mine = {key: value.split(",") if "-m" in words else [value] for key, value in given if key in names}
    for values in product(*mine.values()):
        CONFIGS[recipe.stem].from_mapping({key: yaml.safe_load(v) for key, v in zip(mine, values, strict=True)})


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[command for _, command in COMMANDS])
def test_every_command_that_a_page_shows_is_understood(page, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(command)
    if words[:1] == ["python"] and words[1].startswith("recipes/"):
        parse_recipe(words[1:])
    elif words[:2] == ["python", "-m"]:
        original = argparse.ArgumentParser.parse_known_args

        def parse(self, args=None, namespace=None):
            _, strange = original(self, args, namespace)
            assert not strange
            raise Parsed

        monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", parse)
        with pytest.raises(Parsed):
            importlib.import_module(home(words[2])).main(words[3:])
    elif words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[:2] == ["pip", "install"]:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert {*re.findall(r"\[(.*)\]", command)} <= {*extras}
    else:
        assert command in EXEMPT


TINY = {
    "recipes/ppo.py": ["total_frames=2048", "epochs=1", "compile=off", "evaluate=false"],
    "recipes/dqn.py": ["total_frames=2048", "learning_starts=1024", "compile=off", "evaluate=false"],
    "uavnav.evaluate": ["--episodes", "2", "--max-steps", "50"],
    "uavnav.render": ["--steps", "20"],
}
"""What is added to a line, so that it takes a second or two."""
PRESUMED = {"docs/bridges.md": ["python recipes/ppo.py"]}
"""What a page takes for granted to have been run."""


@pytest.fixture
def carry_out(tmp_path, monkeypatch):
    """Runs a line in an empty folder, in this process, with tiny settings and a window that closes: its status."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "recipes"))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(machine, "cores", lambda: 1)  # no further processes
    monkeypatch.setattr("uavnav.report.content._figures", lambda *anything: [])  # drawn in test_figures.py
    show = play.show
    monkeypatch.setattr(play, "show", lambda game: (show(game), close_the_window()))

    def run(command):
        if command == "make train":
            (command,) = re.findall(r"^train:.*\n\t\$\(BIN\)/(.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
        _, *words = shlex.split(command)
        name, *given = words[1:] if words[0] == "-m" else words
        given += TINY.get(name, [])
        if words[0] == "-m":
            return importlib.import_module(home(name)).main(given)
        monkeypatch.setattr(sys, "argv", [name, *given])
        runpy.run_path(str(ROOT / name), run_name="__main__")
        return 0

    return run


def close_the_window():
    import pygame

    pygame.event.post(pygame.event.Event(pygame.QUIT))


def untrained_zip(path):
    sb3 = pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    sb3.PPO("MlpPolicy", DroneVecEnv(num_envs=2), n_steps=8, batch_size=16, device="cpu").save(path)


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({page for page, _ in COMMANDS}))
def test_the_commands_of_a_page_run_one_after_the_other(page, carry_out, tmp_path, capfd):
    for name in ("pygame", "av", "onnxscript", "tensorboard"):
        pytest.importorskip(name)
    if any("theirs.zip" in command for where, command in COMMANDS if where == page):
        untrained_zip(tmp_path / "theirs.zip")
    lines = PRESUMED.get(page, []) + [command for where, command in COMMANDS if where == page]
    for command in lines:
        if command not in EXEMPT:
            assert carry_out(command) == 0, command
            assert "arning" not in capfd.readouterr().err, command
            for named in re.findall(r"(?:--out |\bout=)([^\s$]+)", command):
                assert (tmp_path / named).exists(), command


# -- snippets ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MINE)
def test_the_snippets_of_a_page_run_one_after_the_other(name, tmp_path, monkeypatch):
    snippets = blocks(PAGES[name], "python")
    assert snippets
    monkeypatch.chdir(tmp_path)
    for shared in (networks.ACTIVATIONS, rewards.REWARDS, metrics.METRICS):
        for added in ("hardswish", "gentle", "full_stops_per_episode", "slow"):
            monkeypatch.setitem(shared, added, None)  # taken back at the end, whatever the snippets do
            del shared[added]
    names: dict = {}
    for snippet in snippets:
        exec(compile(snippet, f"docs/{name}.md", "exec"), names)


def test_rows_of_a_callable_in_baselines_are_a_column_of_the_report_under_the_files_name(tmp_path):
    rows = uavnav.evaluate_policy(lambda observation, generator: torch.full([len(observation)], 9), episodes=3)
    (tmp_path / "baselines").mkdir()
    rows.to_parquet(tmp_path / "baselines" / "mine.parquet")
    found, unread = frames.baselines([tmp_path])
    assert {name: len(table) for name, table in found.items()} == {"mine": 3}
    assert not unread
    assert 'same.to_parquet("runs/baselines/mine.parquet")' in ALL["docs/bridges.md"]


# -- tables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_the_table_of_settings_is_the_configuration_field_by_field(algorithm):
    rows = table(PAGES[algorithm], "| key | default | unit | meaning |")
    defaults = [(field.name, written(field.default)) for field in dataclasses.fields(CONFIGS[algorithm])]
    assert [(code(row[0])[0], code(row[1])[0]) for row in rows] == defaults
    assert all(row[3] for row in rows)


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_the_table_of_presets_is_that_of_the_configuration(algorithm):
    rows = table(PAGES[algorithm], "| preset | sets |")
    presets = CONFIGS[algorithm].PRESETS
    shown = {code(name)[0]: dict(word.split("=") for word in code(sets)) for name, sets in rows}
    assert shown == {name: {key: str(value) for key, value in sets.items()} for name, sets in presets.items()}


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_the_table_beside_sb3_holds_both_defaults(algorithm):
    sb3 = pytest.importorskip("stable_baselines3")
    theirs = inspect.signature({"ppo": sb3.PPO, "dqn": sb3.DQN}[algorithm]).parameters
    ours = {field.name: field.default for field in dataclasses.fields(CONFIGS[algorithm])}
    rows = table(PAGES[algorithm], "| here | | there | | |")
    assert len(rows) >= 12
    for row in rows:
        for name, value, defaults in ((*row[:2], ours), (*row[2:4], {k: v.default for k, v in theirs.items()})):
            if name:
                assert ast.literal_eval(code(value)[0]) == defaults[code(name)[0]], name


SHORT = {
    "ppo": {"n_worlds": 2, "frames_per_batch": 64, "total_frames": 64, "entropy_coeff": 0.01},
    "dqn": {"n_worlds": 4, "total_frames": 64, "learning_starts": 8, "buffer_size": 64},
}


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_every_logged_column_has_its_line(algorithm, tmp_path):
    first = blocks(PAGES[algorithm], "console")[0].splitlines()[0].partition("#")[0].split()[2:]
    config = CONFIGS[algorithm].from_mapping({**dict(word.split("=") for word in first), **SHORT[algorithm]})
    run = importlib.import_module(f"uavnav.{algorithm}").train(config, out=tmp_path / "run", quiet=True)
    rows = table(PAGES[algorithm], "| column | meaning |")
    assert sorted(code(row[0])[0] for row in rows) == sorted(run.progress.columns)
    assert all(row[1] for row in rows)


def test_the_tables_of_the_start_are_the_recipes_keys_the_runs_files_and_the_episodes_columns():
    page = PAGES["start"]
    keys = {code(row[0])[0]: code(row[1])[0] for row in table(page, "| key | default | meaning |")}
    for algorithm in CONFIGS:
        own = yaml.safe_load((ROOT / "recipes/conf" / f"{algorithm}.yaml").read_text())
        assert keys == {key: yaml.dump(own[key]).split("\n")[0] for key in own if key not in ("defaults", "hydra")}
    files = [code(row[0])[0] for row in table(page, "| file | holds |")]
    assert {*files} == {*runs.FILES, runs.EVALUATION, runs.BEHAVIOUR, "checkpoint/"}
    assert [code(row[0])[0] for row in table(page, "| column | meaning |")] == list(metrics.EPISODE_COLUMNS)


# -- names in code ----------------------------------------------------------------------------------------------------


def found(dotted):
    """Whether `World.width`, `PPOConfig.lr`, `sensing.sense` or `runs.Recorder.finish` is there."""
    first, *rest = dotted.split(".")
    here = CLASSES[first] if first in CLASSES else importlib.import_module(f"uavnav.{first}")
    for name in rest:
        if not hasattr(here, name) and name not in getattr(here, "__annotations__", {}):
            return False
        here = getattr(here, name, None)
    return True


FILES = (".py", ".parquet", ".yaml")
MODULES = {*uavnav._MODULES, *uavnav.HOMES}


@pytest.mark.parametrize("name", MINE)
def test_every_name_in_code_exists(name):
    prose = re.sub(r"```.*?```", "", PAGES[name], flags=re.DOTALL)
    dotted = {one for one in code(prose) if re.fullmatch(r"\w+(\.\w+)+", one) and not one.endswith(FILES)}
    known = {one for one in dotted if one.split(".")[0] in MODULES | {*CLASSES}}
    assert not [one for one in known if not found(one)]
    assert len(known) >= {"world": 35, "ppo": 15, "dqn": 15, "extending": 8}.get(name, 0)


GREEK = r"\\(?:alpha|beta|gamma|delta|epsilon|theta|lambda|pi|rho|sigma|tau)(?![A-Za-z])"


def symbols(tex):
    """The letters of an equation, with a prime and a subscript that is no index: x', R_s, V_target."""
    tex = re.sub(r"_\{\\text\{(\w+)\}\}", r"_\1 ", tex.replace("\\\\", " "))
    tex = re.sub(r"\\(?:begin|end|text|operatorname|mathbb)\{[^}]*\}(?:\{rcl\})?", " ", tex)
    tex = re.sub(rf"(?!{GREEK})\\[A-Za-z]+", " ", tex)
    found = re.findall(rf"({GREEK}|[A-Za-z])('?)(?:_(\w+))?", tex)
    return {name + prime + (f"_{index}" if index not in {"", *"itk1n"} else "") for name, prime, index in found}


@pytest.mark.parametrize(("name", "least"), [("world", 14), ("ppo", 18), ("dqn", 11)])
def test_every_symbol_of_an_equation_is_in_a_table_of_its_page(name, least):
    equations = re.findall(r"\$\$(.*?)\$\$", PAGES[name], flags=re.DOTALL)
    cells = re.findall(r"^\| ([^|]*\$[^|]*) \|", PAGES[name], flags=re.MULTILINE)
    explained = set().union(*(symbols(tex) for cell in cells for tex in re.findall(r"\$([^$]+)\$", cell)))
    used = set().union(*map(symbols, equations))
    assert len(used) >= least
    assert not used - explained


def test_every_symbol_of_the_world_is_a_variable_of_the_function_that_it_is_said_to_be():
    count = 0
    for names, function in re.findall(r"((?:`\w+`(?:, )?)+) of `(\w+\.\w+)`", PAGES["world"]):
        home, _, attribute = function.partition(".")
        body = getattr(importlib.import_module(f"uavnav.{home}"), attribute)
        for name in code(names):
            there = name in body.__code__.co_varnames or f'"{name}"' in inspect.getsource(body)
            assert there, f"{name} of {function}"
            count += 1
    assert count >= 15


def test_every_field_of_the_world_is_on_its_page_or_in_its_equations():
    fields = {field.name for field in dataclasses.fields(World)}
    in_words = {"width", "height"}  # 800 x 600 px
    assert {one for one in fields if f"World.{one}`" not in PAGES["world"]} == in_words
    assert "800 × 600 px" in PAGES["world"]
    assert {*SWITCHES} <= fields


# -- error lines ------------------------------------------------------------------------------------------------------

ERRORS = {
    *("ConfigError", "LayoutError", "PolicyError", "RunError", "CheckpointError", "HydraException"),
    *("ValueError", "AttributeError", "ImportError", "ResetNeeded"),
}
IN_BRACKETS = {"more than … bytes of weights", "not a table of float32 tensors", "… has more than … bytes"}
"""Said in the brackets of another line alone."""


def message(node):
    """A string of the source, with … for what it is filled with; hints of the nearest choice are left out."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value.replace("{}", "…").strip()
    if isinstance(node, ast.JoinedStr):
        hints = {"choose_from": "choose from …", "did_you_mean": ""}
        parts = []
        for part in node.values:
            called = getattr(getattr(getattr(part, "value", None), "func", None), "id", "")
            parts.append(part.value if isinstance(part, ast.Constant) else hints.get(called, "…"))
        return re.sub("…+", "…", "".join(parts)).strip()
    return None


def says(line, message):
    """Whether a line of the page is one that the message can become: `…` may be more words on the page."""
    return re.fullmatch(".*".join(map(re.escape, message.split("…"))), line) is not None


def telling(message):
    return message is not None and len(re.findall(r"[a-z]", message)) >= 8


def sources():
    for path in [*(ROOT / "uavnav").rglob("*.py"), ROOT / "recipes" / "launch.py"]:
        yield from ast.walk(ast.parse(path.read_text()))


def on_the_page():
    lines = re.findall(r"^\| (`{1,2})(.+?)\1 \| (.+) \| (.+) \|$", PAGES["troubleshooting"], flags=re.MULTILINE)
    return [line for _, line, _, _ in lines]


def test_every_error_line_of_the_page_is_in_the_source():
    there = {message(node) for node in sources()}
    assert len(on_the_page()) >= 100
    gone = [
        line
        for line in on_the_page()
        if line not in there and not any(says(line, one) for one in there if telling(one))
    ]
    assert not gone
    assert len(set(on_the_page())) == len(on_the_page())


def test_every_error_line_of_the_source_is_on_the_page():
    missing = []
    for node in sources():
        called = isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", ""))
        if called in ERRORS and node.args:
            line = message(node.args[0])
            if telling(line) and line not in IN_BRACKETS and not any(says(shown, line) for shown in on_the_page()):
                missing.append(line)
    assert not missing, "a row for each in docs/troubleshooting.md"
