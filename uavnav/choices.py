"""Answers to a wrong word: the choices, the nearest one, and a parser of command lines that says both in one line."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Collection
from typing import Any, NoReturn


def did_you_mean(value: object, choices: Collection[str]) -> str:
    """` (did you mean relu?)`, the nearest of the choices, as the end of a message; empty where none is near."""
    near = difflib.get_close_matches(str(value), choices, n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def choose_from(value: object, choices: Collection[str]) -> str:
    """`choose from elu, gelu (did you mean gelu?)`: the choices in order of name, and the nearest."""
    return f"choose from {', '.join(sorted(choices))}{did_you_mean(value, choices)}"


class Parser(argparse.ArgumentParser):
    """Of a command `python -m uavnav.x`: what is wrong is one line `uavnav.x: ...`, and status 2."""

    def error(self, message: str) -> NoReturn:
        name = self.prog.removeprefix("python -m ")
        self.exit(2, f"{name}: {message}; {self.prog} --help says more\n")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse, and suggests an option where a word is none."""
        found, strange = self.parse_known_args(args, namespace)
        if strange:
            options = [option for action in self._actions for option in action.option_strings]
            word = strange[0].partition("=")[0]
            self.error(f"there is no argument {word}{did_you_mean(word, options)}")
        return found

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, f"{value}: {choose_from(value, list(action.choices))}")
