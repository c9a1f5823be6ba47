"""`python -m uavnav`: what one can do, a line each, as the commands themselves say it; nothing of them is imported."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.choices import choose_from

HERE = Path(__file__).parent
RECIPES = HERE.parent / "recipes"
TRAINING = tuple(ALGORITHMS)
COMMANDS = ("evaluate", "play", "render", "report", "verify", "export", "layouts", "bench")
"""Modules that have a `main`, in the order in which one needs them."""
EXAMPLE = "python -m uavnav.render reactive random --layout 20 --out flight.gif"
"""Needs no training."""


def module_of(command: str) -> str:
    """Where a command's `main` is."""
    home = uavnav.HOMES.get(command, f"uavnav.{command}")
    return f"{home}.__main__" if (HERE / command).is_dir() else home


def said(path: Path, function: str = "") -> str:
    """The first line of a file's docstring, or of that of a function in it."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == function]
    return (ast.get_docstring(nodes[0] if function else tree) or "").partition("\n")[0]


def listing() -> str:
    """The commands with what each does, and where to read on."""
    if RECIPES.is_dir():
        training = {f"python recipes/{name}.py": said(RECIPES / f"{name}.py") for name in TRAINING}
        docs = f"{HERE.parent / 'README.md'} and the folder docs beside it"
    else:
        training = {f"uavnav.{name}.train(...)": said(HERE / "algorithms" / f"{name}.py") for name in TRAINING}
        docs = "README.md and the folder docs of the repository; help(uavnav.ppo.train) in Python"
    files = {name: HERE.joinpath(*module_of(name).split(".")[1:]).with_suffix(".py") for name in COMMANDS}
    others = {f"python -m uavnav.{name}": said(path, "main") for name, path in files.items()}
    width = max(map(len, training | others))
    head = said(HERE / "__init__.py").removeprefix("uavnav: ")
    lines = [f"uavnav {uavnav.__version__}: {head}", ""]
    lines += [f"  {command:{width}}  {what}" for command, what in (training | others).items()]
    lines += ["", f"Such as: {EXAMPLE}", "", "Each says more with --help.", f"Read on in {docs}."]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """List the commands, or run the one that is named, with the arguments after it."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "--version"):
        print(uavnav.__version__ if words[:1] == ["--version"] else listing())
        return 0
    if words[0] in TRAINING:
        how = f"python recipes/{words[0]}.py" if RECIPES.is_dir() else f"uavnav.{words[0]}.train(...) in Python"
        print(f"uavnav: {words[0]} is no command; to train with it: {how}", file=sys.stderr)
        return 2
    if words[0] not in COMMANDS:
        print(f"uavnav: there is no command {words[0]!r}; {choose_from(words[0], COMMANDS)}", file=sys.stderr)
        return 2
    status: int = importlib.import_module(module_of(words[0])).main(words[1:])
    return status


if __name__ == "__main__":
    sys.exit(main())
