"""Errors in one line: short, printable, and without the line breaks of what a user gave."""

from __future__ import annotations

import sys

MOST = 270
"""Characters of a message; with the command before it, a line has at most 300."""
WORD = 40
"""Characters that a word keeps at least in a message that is too long."""


def one_line(text: object, most: int = MOST) -> str:
    r"""A text as one printable line of at most `most` characters.

    Long words are shortened first, in their middle and no more than needed; then the middle of the line: what is wrong
    stands at its beginning, and what would be right at its end.

    >>> one_line("a\nb")
    'a\\nb'
    >>> one_line(f"out={'x' * 999}: is a file", 60)
    'out=xxxxxxxxxxxxxxxxxxx…xxxxxxxxxxxxxxxxxxxxxxx: is a file'
    """
    line = "".join(one if one.isprintable() else _escaped(one) for one in str(text))
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


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def told(value: object, most: int = WORD * 2) -> str:
    """A value as a message shows it: short and in one line, however large, deep or odd it is."""
    try:
        return one_line(value, most)
    except (ValueError, RecursionError, RuntimeError):  # a number of many digits, nested lists, a damaged tensor
        return f"a {type(value).__name__}"


def quoted(value: object) -> str:
    """The same, with the quotes of a word."""
    return told(repr(value)) if isinstance(value, str) else told(value)


class OneLineError(Exception):
    """What is wrong with what a user gave; its message is one line of at most `MOST` characters."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))
