"""Errors in one line: short, printable, with the choices; and a parser of command lines that says them."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Collection
from typing import Any, NoReturn

MOST = 270
"""Characters of a message; with the command before it, a line has at most 300."""
WORD = 40
"""Characters that a word keeps at least in a message that is too long."""
LONG = 170
"""Characters of choices that are listed whole."""
MOST_WHOLE = 2**53
"""The largest whole number that a user may give: a float has no more digits."""
SOME = 5
"""Choices that are named where there are too many."""


def one_line(text: object, most: int = MOST) -> str:
    r"""A text as one printable line of at most `most` characters.

    Long words are shortened first, in their middle and no more than needed; then the middle of the line: what
    is wrong stands at its beginning, and what would be right at its end.

    >>> one_line("a\nb")
    'a\\nb'
    >>> one_line(f"out={'x' * 999}: is a file", 60)
    'out=xxxxxxxxxxxxxxxxxxx…xxxxxxxxxxxxxxxxxxxxxxx: is a file'
    """
    line = "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in str(text))
    words = line.split(" ")
    kept = max(map(len, words))
    while len(line) > most and kept > WORD:
        kept = max(WORD, kept * 9 // 10)
        line = " ".join(shortened(word, kept) for word in words)
    return shortened(line, most)


def shortened(text: str, most: int) -> str:
    """A text of at most so many characters, its middle left out where it is longer."""
    kept = most - 1
    return text if len(text) <= most else f"{text[: kept // 2]}…{text[len(text) - (kept - kept // 2) :]}"


def complain(command: str, error: object) -> None:
    """Say on stderr, in one line, why a command does not do what it was asked for."""
    print(one_line(f"uavnav {command}: {error}", MOST + 30), file=sys.stderr)


def told(value: object, most: int = WORD * 2) -> str:
    """A value as a message shows it: short and in one line, however large, deep or odd it is."""
    try:
        return one_line(value, most)
    except (ValueError, RecursionError, RuntimeError):
        # a number of many digits, nested lists, a damaged tensor
        return f"a {type(value).__name__}"


def quoted(value: object) -> str:
    """The same, with the quotes of a word."""
    return told(repr(value)) if isinstance(value, str) else told(value)


class OneLineError(Exception):
    """What is wrong with what a user gave; its message is one line of at most `MOST` characters."""

    status = 2
    """Of a command that ends with it."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))


def nearest(value: object, choices: Collection[str]) -> str:
    """The nearest of the choices; empty where none is near."""
    word = told(value)
    of_a_part = [choice for choice in choices if choice.endswith(f".{word}")]  # `slots` for `world.slots`
    return next(iter(of_a_part or difflib.get_close_matches(word, choices, n=1)), "")


def did_you_mean(value: object, choices: Collection[str]) -> str:
    """` (did you mean relu?)`, the nearest choice, for a message that does not list them; often empty."""
    near = nearest(value, choices)
    return f" (did you mean {near}?)" if near else ""


def choose_from(value: object, choices: Collection[str]) -> str:
    """`did you mean gelu? choose from elu, gelu`: the nearest choice, and all or some of them."""
    choices = [told(choice) for choice in choices]  # a file may have keys that are no words
    names = sorted(choices)
    if len(", ".join(names)) > LONG:
        near = difflib.get_close_matches(told(value), names, n=SOME, cutoff=0.4)
        names = [f"{len(names)}, such as {', '.join(near or names[:SOME])}"]
    meant = nearest(value, choices)
    return f"{meant and f'did you mean {meant}? '}choose from {', '.join(names)}"


def among(value: object, choices: Collection[str]) -> bool:
    """Whether a value is one of some names; what is no name is none of them."""
    return isinstance(value, str) and value in choices


class ConfigError(OneLineError, ValueError):
    """A key or a value of a configuration is wrong; the message is one line that names it and the choices."""


def unknown(name: str, value: object, choices: Collection[str]) -> ConfigError:
    """The error for a value that is not among the choices, with the nearest one suggested."""
    return ConfigError(f"{name}={told(value)}; {choose_from(value, choices)}")


def unknown_key(key: object, choices: Collection[str]) -> ConfigError:
    """The error for a key that is not among the choices, with the nearest one suggested."""
    return ConfigError(f"there is no key {quoted(key)}; {choose_from(key, choices)}")


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


def telling_line(error: BaseException) -> str:
    """The most telling line of an error's message: the compiler's own error, else the first line that names a
    cause.

    >>> telling_line(Exception("backend='inductor' raised:\\nCppCompileError: C++ compile error"))
    'CppCompileError: C++ compile error'
    """
    lines = [
        line.strip() for line in str(error).splitlines() if line.strip() and not line.endswith("raised:")
    ]
    return next((line for line in lines if "error: " in line), lines[0] if lines else type(error).__name__)
