"""The pages of docs/ hold what they show: the site builds, commands parse, snippets run, tables are the code's."""

import argparse
import ast
import dataclasses
import importlib
import importlib.util
import inspect
import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import pytest
import yaml

from uavnav import metrics, networks, rewards, runs
from uavnav.config import SWITCHES
from uavnav.dqn import DQNConfig
from uavnav.ppo import PPOConfig
from uavnav.simulator import Outcome, State
from uavnav.world import World

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
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
        assert f'id="uavnav.{name}.{word}"' in site[f"api/{name}.html"]


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
    assert "uavnav/world.py</code>" in site["world.html"]
    assert not [
        name
        for name, page in site.items()
        if re.search(r'href="?(\.\./)+(uavnav/|results/|tests/|README|CONTRIBUTING)', page)
    ]


def test_the_hook_tells_of_a_file_that_is_missing(caplog, monkeypatch):
    pytest.importorskip("latex2mathml")
    spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    hooks.log.addHandler(caplog.handler)  # mkdocs, once imported, lets nothing through to the root
    monkeypatch.setattr(hooks.log, "disabled", False)

    class Here:
        src_uri = "page.md"
        config_file_path = str(ROOT / "mkdocs.yml")
        file = property(lambda self: self)

    def shown(text):
        return hooks.on_page_markdown(text, page=Here(), config=Here())

    assert shown("see [the module](../uavnav/ppo.py)") == "see the module (`uavnav/ppo.py`)"
    assert shown("see [`uavnav/ppo.py`](../uavnav/ppo.py)") == "see `uavnav/ppo.py`"
    assert shown("see [PPO](../docs/ppo.md)") == "see [PPO](../docs/ppo.md)"
    assert not caplog.records
    shown("see [nothing](../uavnav/nothing.py)")
    assert "uavnav/nothing.py, which is not in the repository" in caplog.text


# -- commands ---------------------------------------------------------------------------------------------------------

COMMANDS = [
    (name, line.partition(" #")[0].strip())
    for name, page in ALL.items()
    for block in blocks(page, "console")
    for line in block.replace("\\\n", " ").splitlines()
    if line.strip() and not line.startswith("#")
]


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
        package = find_spec(words[2]).submodule_search_locations
        with pytest.raises(Parsed):
            importlib.import_module(f"{words[2]}.__main__" if package else words[2]).main(words[3:])
    elif words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[:2] == ["pip", "install"]:
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert {*re.findall(r"\[(.*)\]", command)} <= {*extras}
    else:
        assert command in ("python3.11 -m venv .venv", "source .venv/bin/activate", "pytest -n 2")


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
MODULES = {path.stem for path in (ROOT / "uavnav").glob("*.py")}


@pytest.mark.parametrize("name", MINE)
def test_every_name_in_code_exists(name):
    prose = re.sub(r"```.*?```", "", PAGES[name], flags=re.DOTALL)
    dotted = {one for one in code(prose) if re.fullmatch(r"\w+(\.\w+)+", one) and not one.endswith(FILES)}
    known = {one for one in dotted if one.split(".")[0] in MODULES | {*CLASSES}}
    assert not [one for one in known if not found(one)]
    assert len(known) >= {"world": 35, "ppo": 15, "dqn": 15, "extending": 10}.get(name, 0)


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

ERRORS = ("ConfigError", "LayoutError", "PolicyError", "RunError", "CheckpointError")


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
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERRORS and node.args:
            line = message(node.args[0])
            if telling(line) and not any(says(shown, line) for shown in on_the_page()):
                missing.append(line)
    assert not missing, "a row for each in docs/troubleshooting.md"
