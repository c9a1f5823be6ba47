"""A parser of command lines that says in one line what is wrong."""

from __future__ import annotations

import argparse
import io
import re
import sys
from typing import Any, NoReturn

from uavnav.errors import MOST, MOST_WHOLE, choose_from, did_you_mean, one_line, told


def whole(text: str) -> int:
    """A whole number of a command line, as the type of an argument."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"invalid int value: {text!r}") from None
    if abs(number) > MOST_WHOLE:
        raise argparse.ArgumentTypeError(f"{told(number)} is too large; give at most {MOST_WHOLE:,}")
    return number


class Parser(argparse.ArgumentParser):
    """Of a command: what is wrong is one line `uavnav verify: ...`, and status 2."""

    def error(self, message: str) -> NoReturn:
        self.refuse(f"{message}; {self.prog} --help says more")

    def refuse(self, message: str) -> NoReturn:
        """End the process with a line that says what is wrong."""
        self.exit(2, one_line(f"{self.prog.removeprefix('python -m ')}: {message}", MOST + 30) + "\n")

    def flags(self) -> list[str]:
        """All that this command takes, as its help lists them."""
        return re.findall(r"^  (?:-\w[^-]*)?(--[a-z-]+)", self.format_help(), re.MULTILINE)

    def leave(self, text: str) -> NoReturn:
        """End the process with a text that was asked for."""
        self._print_message(text, sys.stdout)
        self.exit()

    def _print_message(self, message: str, file: Any = None) -> None:
        if isinstance(file, io.TextIOWrapper):
            file.reconfigure(errors="replace")  # what the terminal cannot show is printed as `?`
        super()._print_message(message, file)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse, and suggests an option where a word is none."""
        found, strange = self.parse_known_intermixed_args(args, namespace)
        if strange:
            word = strange[0].partition("=")[0]
            self.error(f"there is no argument {word}{did_you_mean(word, self.flags())}")
        return found

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, f"{value}: {choose_from(value, list(action.choices))}")
