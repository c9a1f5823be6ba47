"""`import uavnav` is cheap, and every name that it promises is there."""

import ast
import json
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.cli.commands import COMMANDS

PACKAGE = Path(uavnav.__file__).parent


@pytest.mark.parametrize("name", sorted({*uavnav.__all__, *uavnav.HOMES, *uavnav._MODULES}))
def test_every_public_name_resolves(name):
    assert getattr(uavnav, name) is not None


def test_two_dozen_names_are_shown_at_the_top_and_a_type_checker_knows_each():
    assert {*dir(uavnav)} == {*uavnav.__all__, "__version__"}
    assert len(uavnav.__all__) <= 24
    (known,) = [
        node
        for node in ast.parse(MODULES["uavnav"].read_text()).body
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
    ]
    assert {alias.name for line in known.body for alias in line.names} == {*uavnav.__all__}


# -- what is loaded ------------------------------------------------------------------------------------------

HELPS = [
    [],
    ["--version"],
    ["train"],
    ["evalute"],
    ["verify"],
    *([name, "--help"] for name in COMMANDS),
    *(["train", name, "--help"] for name in ALGORITHMS),
    ["train", "ppo", "--activation", "relu"],
]
RUNS = ["results/algorithms/fast/ppo/tanh", "results/algorithms/fast/ppo/sigmoid", "reactive"]
FLIGHTLESS = [
    "configurations",
    "claims",
    "verdicts",
    "studies",
    "frames",
    "tables",
    "quotes",
    "charts",
    "arena",
    "worlds",
]
WHOLE = ["report.content", "report.behaviour", "views.replays", "report.page", "report.docs"]
HEAVY = {"torch", "pandas", "matplotlib", "pydantic", "rich", "pygame", "PIL", "pyarrow"}
PEERS = ["stable_baselines3", "sbx", "jax"]
TRAIN = {f"uavnav.training.{name}" for name in ("loop", "update", "recorder", "workers")}
TRAIN |= {"uavnav.algorithms.ppo", "uavnav.algorithms.dqn", "uavnav.envs.env", "torchrl", *PEERS}
STEPS = {
    "the package and its environment": (
        "import gymnasium, uavnav; assert 'uavnav/Drone-v0' in gymnasium.registry",
        HEAVY,
    ),
    "help and mistakes in the words of a command": (
        f"""
from contextlib import suppress
from uavnav.__main__ import main
for words in {HELPS}:
    with suppress(SystemExit):
        main(words)""",
        HEAVY,
    ),
    "statistics": ("import uavnav.stats", {"torch", "uavnav.report", "uavnav.runs"}),
    "what of a report does not fly": (
        f"import {', '.join(f'uavnav.report.{name}' for name in FLIGHTLESS)}",
        {"torch"},
    ),
    "committed runs compared": (f"assert main(['compare', *{RUNS}]) == 0", {"torch"}),
    "all of a report": (f"import {', '.join(f'uavnav.{name}' for name in WHOLE)}", TRAIN),
    "benchmarks where no peer is installed": (
        f"""
sys.modules.update(dict.fromkeys({PEERS}))
from uavnav.cli.bench import BY_DEFAULT, plan
assert len(plan(BY_DEFAULT, True)) > 15""",
        set(),
    ),
    "a training without a logger": (
        """
from uavnav.algorithms.ppo import PPOConfig, train
config = PPOConfig(total_frames=64, frames_per_batch=64, compile="off")
train(config, pathlib.Path(sys.argv[1], "run"), quiet=True)""",
        {"wandb", "tensorboard"},
    ),
}
"""One after the other in one process: what to run, and what is not there even then."""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """The modules that are there after each step."""
    folder = tmp_path_factory.mktemp("loaded")
    lines = [f"{code}\nloaded.append([*sys.modules])" for code, _ in STEPS.values()]
    save = "pathlib.Path(sys.argv[1], 'loaded.json').write_text(json.dumps(loaded))"
    program = "\n".join(["import json, pathlib, sys", "loaded = []", *lines, save])
    words = [sys.executable, "-c", program, folder]
    subprocess.run(words, cwd=PACKAGE.parent, stdout=subprocess.DEVNULL, check=True)
    found = dict(zip(STEPS, json.loads((folder / "loaded.json").read_text()), strict=True))
    assert "torch" in found["all of a report"]  # else nobody would tell
    return found


@pytest.mark.parametrize("step", STEPS)
def test_what_is_light_loads_nothing_heavy(loaded, step):
    assert not STEPS[step][1] & {*loaded[step]}


# -- the house -----------------------------------------------------------------------------------------------

MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}


def imported(name):
    """The modules of the package that a module imports, also within functions."""
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (one if one in MODULES else node.module for one in inner)


def room(name):
    """The table of algorithms is one of its own, below those that it names."""
    return "the table" if name == "uavnav.algorithms" else ".".join(name.split(".")[:2])


@pytest.mark.parametrize("of", [str, room], ids=["file", "room"])
def test_no_two_import_each_other_not_even_by_way_of_others(of):
    above = {of(name): set() for name in MODULES}
    for name in MODULES:
        # names found on first use; a command by another name
        if name not in (
            "uavnav",
            "uavnav.report.__main__",
        ):
            above[of(name)] |= {of(other) for other in imported(name)} - {of(name), "uavnav"}
    try:
        assert len([*TopologicalSorter(above).static_order()]) == len(above)
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_module_of_tests_imports_another():
    for path in Path(__file__).parent.glob("*.py"):
        assert not re.search(r"^\s*(from|import) test_", path.read_text(), re.MULTILINE), path.name
