"""One colour for one pilot, in figures, films, pages and the playground; safe for colour-blind readers.

And how activations are spelled there.
"""

from __future__ import annotations

from collections.abc import Iterable

from uavnav.tasks.protocol import SCRIPTED

PILOTS = {"you": "#E69F00", "ppo": "#0072B2", "dqn": "#D55E00", **dict.fromkeys(SCRIPTED, "#009E73")}
"""By who flies: a person, an algorithm's policy, a scripted policy."""
OTHERS = ("#CC79A7", "#56B4E9", "#000000", "#882255", "#999933")
"""Of further pilots, in their order: Okabe and Ito's without the yellow, then Paul Tol's wine and olive."""
NAMES = {"tanh": "tanh", "sigmoid": "sigmoid", "relu": "ReLU", "leaky_relu": "leaky ReLU", "crelu": "CReLU"}
"""Activations in words."""


def colours(pilots: Iterable[str]) -> list[str]:
    """A colour for each pilot of one picture or page, in their order.

    pilots: `you`, an algorithm's or a scripted policy's name. The first of a kind has its kind's colour; each
        further one has the next of `OTHERS`.
    """
    result: list[str] = []
    others = 0
    for pilot in pilots:
        colour = PILOTS.get(pilot, "")
        if not colour or colour in result:
            colour = OTHERS[others % len(OTHERS)]
            others += 1
        result.append(colour)
    return result


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour such as #0072B2 as red, green and blue from 0 to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
