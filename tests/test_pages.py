"""The pages say what the code says: tables, names and symbols are compared with it."""

import ast
import importlib
import inspect
import re
import runpy

import pytest
from pages import ALL, CONFIGS, DOCS, MINE, PAGES, ROOT, blocks, code, table

import uavnav
from uavnav import runs, studies
from uavnav.report.page import DECISIONS
from uavnav.runs import metrics
from uavnav.tasks.faults import Faults
from uavnav.tasks.layouts import SPLITS
from uavnav.tasks.protocol import LADDER_NAMES
from uavnav.tasks.rewards import Step
from uavnav.tasks.state import State
from uavnav.tasks.task import Outcome, Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

CLASSES = {
    one.__name__: one for one in (World, Faults, State, Outcome, Step, Task, WrappedTask, *CONFIGS.values())
}


# -- tables --------------------------------------------------------------------------------------------------


TABLES = runpy.run_path(str(ROOT / "docs" / "tables.py"))


@pytest.mark.parametrize(
    ("page", "block", "text"),
    [
        ("algorithms", "settings", TABLES["settings_table"](CONFIGS)),
        ("algorithms", "presets", TABLES["preset_table"](CONFIGS)),
        ("commands", "commands", TABLES["command_table"]()),
    ],
)
def test_a_generated_table_is_what_the_code_says(page, block, text):
    assert f"<!-- {block} -->\n{text}\n<!-- end" in ALL[f"docs/{page}.md"], "make help writes it"


def test_a_setting_shows_each_algorithms_default_and_what_fast_sets_instead():
    rows = {
        row[0]: row[1:]
        for row in table(ALL["docs/algorithms.md"], "| key | PPO | DQN | A2C | C51 | SAC | PQN |")
    }
    assert rows["`lr`"] == [
        "0.0003→0.001",
        "0.0001→0.00025",
        "0.0007→0.00086",
        "0.00025",
        "0.0003→0.0023",
        "0.0005",
    ]
    assert rows["`epochs`"] == ["10→8", "", "", "", "", "2"]
    assert "\n- Only DQN and C51: `target_update_frames=10000→1000`, " in ALL["docs/algorithms.md"]
    assert "\n- Only SAC: `tau=0.005→0.0037`, " in ALL["docs/algorithms.md"]


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_the_table_of_names_in_sb3_has_the_defaults_of_both(algorithm):
    sb3 = pytest.importorskip("stable_baselines3")
    theirs = inspect.signature(getattr(sb3, algorithm.upper())).parameters
    ours = CONFIGS[algorithm].model_fields
    (head,) = [line for line in PAGES[algorithm].splitlines() if line.startswith("| here | there |")]
    rows = table(PAGES[algorithm], head)
    assert len(rows) >= 8
    for here, there, *defaults in rows:
        assert ast.literal_eval(code(defaults[0])[0]) == ours[code(here)[0]].default, here
        assert ast.literal_eval(code(defaults[-1])[0]) == theirs[code(there)[0]].default, there


def test_the_tables_of_the_start_are_the_runs_files_and_the_episodes_columns():
    page = PAGES["start"]
    files = [code(row[0])[0] for row in table(page, "| file | contains |")]
    of_evaluations = {runs.EVALUATION, runs.BEHAVIOUR, runs.ARENA, runs.VALUES}
    kept = f"{runs.KEPT}0.1.safetensors"
    assert {*files} == {*runs.FILES, *of_evaluations, kept, "checkpoint/", "workers/"}
    assert [code(row[0])[0] for row in table(page, "| column | meaning |")] == list(metrics.EPISODE_COLUMNS)


# -- names in code -------------------------------------------------------------------------------------------


def modules():
    """Every module of the package by its own name; a name that two of them have is that of the one uavnav
    offers.
    """
    paths = [path.relative_to(ROOT).with_suffix("") for path in sorted((ROOT / "uavnav").rglob("*.py"))]
    names = [".".join(path.parent.parts if path.stem == "__init__" else path.parts) for path in paths]
    offered = {name: f"uavnav.{name}" for name in uavnav._MODULES} | uavnav.HOMES
    return {name.rpartition(".")[2]: name for name in names} | offered


MODULES = modules()
MISSING = object()
FILES = (".py", ".parquet", ".yaml", ".safetensors")


def resolved(dotted):
    """What `World.width`, `PPOConfig.lr`, `sensing.sense` or `task.Task.step` names, or MISSING.

    A field without a default is its annotation.
    """
    first, *rest = dotted.split(".")
    here = CLASSES[first] if first in CLASSES else importlib.import_module(MODULES[first])
    for name in rest:
        fields = getattr(here, "__annotations__", {}) | getattr(here, "model_fields", {})
        here = getattr(here, name, fields.get(name, MISSING))
    return here


@pytest.mark.parametrize("name", MINE)
def test_every_name_in_code_exists(name):
    prose = re.sub(r"```.*?```", "", PAGES[name], flags=re.DOTALL)
    dotted = {one for one in code(prose) if re.fullmatch(r"\w+(\.\w+)+", one) and not one.endswith(FILES)}
    known = {one for one in dotted if one.split(".")[0] in {*MODULES, *CLASSES}}
    assert not [one for one in known if resolved(one) is MISSING]
    assert len(known) >= {
        "environment": 35,
        "ppo": 15,
        "dqn": 15,
        "a2c": 12,
        "c51": 15,
        "sac": 12,
        "pqn": 10,
        "extending": 8,
    }.get(name, 0)


GREEK = r"\\(?:alpha|beta|gamma|delta|epsilon|theta|lambda|pi|rho|sigma|tau)(?![A-Za-z])"


def symbols(tex):
    """The letters of an equation, with a prime and a subscript that is no index: x', R_s, V_target."""
    tex = re.sub(r"_\{\\text\{(\w+)\}\}", r"_\1 ", tex.replace("\\\\", " "))
    tex = re.sub(r"\\(?:begin|end|text|operatorname|mathbb)\{[^}]*\}(?:\{rcl\})?", " ", tex)
    tex = re.sub(rf"(?!{GREEK})\\[A-Za-z]+", " ", tex)
    found = re.findall(rf"({GREEK}|[A-Za-z])('?)(?:_(\w+))?", tex)
    return {
        name + prime + (f"_{index}" if index not in {"", *"itk1n"} else "") for name, prime, index in found
    }


@pytest.mark.parametrize(
    ("name", "least"),
    [("environment", 14), ("ppo", 18), ("dqn", 11), ("a2c", 12), ("c51", 14), ("sac", 14), ("pqn", 8)],
)
def test_every_symbol_of_an_equation_is_in_a_table_of_its_page(name, least):
    equations = re.findall(r"\$\$(.*?)\$\$", PAGES[name], flags=re.DOTALL)
    configurations = re.findall(r"^\| ([^|]*\$[^|]*) \|", PAGES[name], flags=re.MULTILINE)
    explained = set().union(
        *(
            symbols(tex)
            for configuration in configurations
            for tex in re.findall(r"\$([^$]+)\$", configuration)
        )
    )
    used = set().union(*map(symbols, equations))
    assert len(used) >= least
    assert not used - explained


def test_every_symbol_of_the_world_is_a_variable_of_the_function_that_it_is_said_to_be():
    count = 0
    for names, function in re.findall(r"((?:`\w+`(?:, )?)+) of `(\w+(?:\.\w+)+)`", PAGES["environment"]):
        body = resolved(function)
        for name in code(names):
            there = name in body.__code__.co_varnames or f'"{name}"' in inspect.getsource(body)
            assert there, f"{name} of {function}"
            count += 1
    assert count >= 15


def test_every_field_of_the_world_is_beside_its_symbol():
    in_words = {"width", "height"}  # 800 x 600 px
    assert {one for one in World.names() if f"World.{one}`" not in PAGES["environment"]} == in_words
    assert "800 × 600 px" in PAGES["environment"]


def test_the_table_of_splits_has_each_with_its_layouts_and_seed():
    rows = table(PAGES["environment"], "| split | layouts | seed | for |")
    assert [tuple(row[:3]) for row in rows] == [
        (f"`{name}`", f"{split.n:,}", str(split.seed)) for name, split in SPLITS.items()
    ]


def test_the_tables_of_tasks_faults_and_ladders_have_each_of_them():
    page = PAGES["tasks"]
    assert {code(row[0])[0] for row in table(page, "| fault | what happens |")} == {*Faults.names()}
    assert {code(row[0])[0] for row in table(page, "| ladder | rungs | one rung |")} == {*LADDER_NAMES}
    (head,) = [line for line in page.splitlines() if line.startswith("| task | what is different")]
    assert [code(row[0])[0] for row in table(page, head)] == [
        "drone",
        "goal",
        "moving",
        "space",
        "space-moving",
    ]


def test_whoever_chooses_an_algorithm_finds_each_in_the_table():
    (head,) = [
        line for line in ALL["docs/algorithms.md"].splitlines() if line.startswith("| algorithm | policy |")
    ]
    rows = table(ALL["docs/algorithms.md"], head)
    assert sorted(re.search(r"\((\w+)\.md\)", row[0])[1] for row in rows) == sorted(CONFIGS)


@pytest.mark.parametrize("snippet", blocks(ALL["README.md"], "python"))
def test_each_snippet_of_the_readme_runs(snippet, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {})


def test_every_file_that_the_readme_links_to_exists():
    for target in re.findall(r"\]\(([^)#:]+)\)", ALL["README.md"]):
        assert (ROOT / target).is_file(), target


LATER = {"activations.md", "learned-or-classical.md", "pqn.md"}
"""Pages that came after the docs were given their 20,000 words."""


def test_the_readme_has_at_most_900_words_in_110_lines_and_the_docs_20_000_words():
    readme = ALL["README.md"]
    assert len(readme.split()) <= 900
    assert readme.count("\n") <= 110
    pages = [path for path in DOCS.glob("*.md") if path.name not in LATER]
    assert sum(len(path.read_text().split()) for path in pages) <= 20_000 - len(readme.split())


def test_the_table_of_the_decisions_is_the_modules_row_by_row():
    lines = re.sub(r"\[(measured)\]\(.*?\)", r"\1", ALL["docs/decisions.md"]).splitlines()
    header, *decisions = (f"| {' | '.join(decision)} |" for decision in DECISIONS)
    begin = lines.index(header)
    assert lines[begin + 2 : begin + 3 + len(decisions)] == [*decisions, ""]
    assert [number for number, *_ in DECISIONS[1:]] == [str(number) for number in range(1, 17)]


def test_the_glossarys_presets_are_those_of_every_algorithm_with_a_study():
    rows = table(ALL["docs/glossary.md"], "| name | preset | study |")
    named = {code(row[0])[0]: row for row in rows}
    assert [name for name, row in named.items() if row[1].endswith("the default")] == ["paper"]
    for kind in CONFIGS.values():
        assert {"paper", "vectorised"} <= {*kind.PRESETS} & {*named}
        assert kind.model_fields["preset"].default == "paper"
        assert (kind(preset="paper").n_envs, kind(preset="vectorised").n_envs in (16, 64)) == (1, True)
    assert {"paper", "vectorised", "tuned"} <= {*studies.names()}
