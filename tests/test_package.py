"""`import uavnav` is cheap, and every name that it promises is there."""

import ast
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import uavnav


def test_import_loads_no_torch_and_registers_the_gymnasium_environment():
    code = (
        "import sys, uavnav, gymnasium; print('torch' in sys.modules, 'uavnav/Drone-v0' in "
        "gymnasium.registry)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "True"]


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


def test_a_name_that_is_not_there_is_answered_with_those_that_are():
    with pytest.raises(AttributeError, match=r"no attribute 'DroneEnvironment' \(did you mean .*DroneEnv"):
        uavnav.DroneEnvironment  # noqa: B018


# -- the house -----------------------------------------------------------------------------------------------

PACKAGE = Path(uavnav.__file__).parent
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
