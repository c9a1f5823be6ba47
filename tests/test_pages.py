"""The pages say what the code says: tables, names and symbols are compared with it."""

import ast
import importlib
import inspect
import re

import pytest
from pages import ALL, CONFIGS, MINE, PAGES, ROOT, blocks, code, table

import uavnav
from uavnav import runs, settings, studies
from uavnav.cli.train import Command
from uavnav.report.page import DECISIONS
from uavnav.runs import metrics
from uavnav.tasks.faults import Faults
from uavnav.tasks.layouts import SPLITS
from uavnav.tasks.rewards import Step
from uavnav.tasks.state import State
from uavnav.tasks.task import Outcome, Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

CLASSES = {
    one.__name__: one for one in (World, Faults, State, Outcome, Step, Task, WrappedTask, *CONFIGS.values())
}


def said(line):
    """A key as the tables write it: the text of --help."""
    return [f"`{line.name}`", f"`{line.default}`", line.unit, line.meaning]


# -- tables --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_the_table_of_settings_is_the_configuration_field_by_field(algorithm):
    rows = table(PAGES[algorithm], "| key | default | unit | meaning |")
    assert rows == [said(line) for line in settings.lines(CONFIGS[algorithm])]
    assert all(row[3] for row in rows)


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_the_table_of_presets_is_that_of_the_configuration(algorithm):
    rows = table(PAGES[algorithm], "| preset | sets |")
    presets = CONFIGS[algorithm].PRESETS
    shown = {code(name)[0]: dict(word.split("=") for word in code(sets)) for name, sets in rows}
    words = {name: {key: typed(value) for key, value in sets.items()} for name, sets in presets.items()}
    assert shown == words


def typed(value):
    """A setting as a command line has it."""
    return str(list(value)).replace(" ", "") if isinstance(value, tuple) else str(value)


BESIDE_SB3 = "| here | | there | | |"


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_the_table_beside_sb3_holds_both_defaults(algorithm):
    sb3 = pytest.importorskip("stable_baselines3")
    theirs = inspect.signature(getattr(sb3, algorithm.upper())).parameters
    ours = {name: field.default for name, field in CONFIGS[algorithm].model_fields.items()}
    rows = table(PAGES[algorithm], BESIDE_SB3)
    assert len(rows) >= 12
    for row in rows:
        for name, value, defaults in (
            (*row[:2], ours),
            (*row[2:4], {k: v.default for k, v in theirs.items()}),
        ):
            if name:
                assert ast.literal_eval(code(value)[0]) == defaults[code(name)[0]], name


SHORT = {
    "ppo": {"n_envs": 2, "frames_per_batch": 64, "total_frames": 64, "entropy_coeff": 0.01},
    "a2c": {"n_envs": 2, "total_frames": 64, "entropy_coeff": 0.01},
    "dqn": {"n_envs": 4, "total_frames": 64, "learning_starts": 8, "buffer_size": 64},
    "sac": {"n_envs": 4, "total_frames": 64, "learning_starts": 8, "buffer_size": 64},
    "c51": {"n_envs": 4, "total_frames": 64, "learning_starts": 8, "buffer_size": 64},
}


@pytest.mark.parametrize("algorithm", CONFIGS)
def test_every_logged_column_has_its_line(algorithm, tmp_path):
    first = blocks(PAGES[algorithm], "console")[0].splitlines()[0].partition("#")[0].split()[3:]
    config = CONFIGS[algorithm].from_mapping({**dict(word.split("=") for word in first), **SHORT[algorithm]})
    run = getattr(uavnav, algorithm).train(config, out=tmp_path / "run", quiet=True)
    rows = table(PAGES[algorithm], "| column | meaning |")
    assert sorted(code(row[0])[0] for row in rows) == sorted(run.progress.columns)
    assert all(row[1] for row in rows)


def test_the_tables_of_the_start_are_the_keys_of_the_command_the_runs_files_and_the_episodes_columns():
    page = PAGES["start"]
    keys = settings.lines(Command)
    assert table(page, "| key | default | meaning |") == [[*said(key)[:2], key.meaning] for key in keys]
    files = [code(row[0])[0] for row in table(page, "| file | holds |")]
    of_evaluations = {runs.EVALUATION, runs.BEHAVIOUR, runs.ARENA, runs.VALUES}
    assert {*files} == {*runs.FILES, *of_evaluations, "checkpoint/", "workers/"}
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
        "world": 35,
        "ppo": 15,
        "dqn": 15,
        "a2c": 12,
        "c51": 15,
        "sac": 12,
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
    ("name", "least"), [("world", 14), ("ppo", 18), ("dqn", 11), ("a2c", 12), ("c51", 14), ("sac", 14)]
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
    for names, function in re.findall(r"((?:`\w+`(?:, )?)+) of `(\w+(?:\.\w+)+)`", PAGES["world"]):
        body = resolved(function)
        for name in code(names):
            there = name in body.__code__.co_varnames or f'"{name}"' in inspect.getsource(body)
            assert there, f"{name} of {function}"
            count += 1
    assert count >= 15


def test_every_field_of_the_world_is_in_the_table_of_its_settings_and_beside_its_symbol():
    fields = World.names()
    assert table(PAGES["world"], "| field | default | unit | meaning |") == [
        said(line) for line in settings.lines(World)
    ]
    in_words = {"width", "height"}  # 800 x 600 px
    assert {one for one in fields if f"World.{one}`" not in PAGES["world"]} == in_words
    assert "800 × 600 px" in PAGES["world"]


def test_every_fault_is_in_the_table_of_its_page():
    assert table(PAGES["faults"], "| field | default | unit | meaning |") == [
        said(line) for line in settings.lines(Faults)
    ]


def test_the_tables_of_the_world_hold_every_split_and_every_field_of_a_step():
    splits = [(row[0], row[1], row[2]) for row in table(PAGES["world"], "| split | layouts | seed | for |")]
    assert splits == [(f"`{name}`", f"{split.n:,}", str(split.seed)) for name, split in SPLITS.items()]
    held = [name for row in table(PAGES["world"], "| field | holds |") for name in code(row[0])]
    assert held == [f"Step.{name}" for name in Step._fields]


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


def test_the_table_of_the_decisions_is_the_modules_row_by_row():
    lines = ALL["docs/decisions.md"].splitlines()
    header, *decisions = (f"| {' | '.join(decision)} |" for decision in DECISIONS)
    begin = lines.index(header)
    assert lines[begin + 2 : begin + 3 + len(decisions)] == [*decisions, ""]
    assert [number for number, *_ in DECISIONS[1:]] == [str(number) for number in range(1, 17)]


def test_the_glossarys_presets_are_those_of_every_algorithm_with_a_study():
    rows = table(ALL["docs/glossary.md"], "| name | preset | study |")
    named = {code(row[0])[0]: row for row in rows}
    assert [name for name, row in named.items() if row[1].endswith("the default")] == ["vectorised"]
    for kind in CONFIGS.values():
        assert {"paper", "vectorised"} <= {*kind.PRESETS} & {*named}
        assert kind.model_fields["preset"].default == "vectorised"
        assert (kind(preset="paper").n_envs, kind(preset="vectorised").n_envs in (16, 64)) == (1, True)
    assert {"paper", "vectorised", "tuned"} <= {*studies.names()}
