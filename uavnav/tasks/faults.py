"""What goes wrong between the environment and a policy: noise, lost echoes, late observations, an actuator
that sticks.

The settings are read without torch. The functions are pure; the random numbers come in as tensors, which a
task draws (`wrapper.WrappedTask.draw`). Letters: B the batch shape (any, also none), S slots of an
observation.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

from uavnav.errors import MOST_WHOLE, ConfigError, told, unknown_key
from uavnav.settings import AtLeast0, Settings, Share, Whole, at_most, key

if TYPE_CHECKING:
    from torch import Tensor

MOST_REMEMBERED = 1_000
"""The most steps of delay, and the most stacked observations: a state keeps them all."""


class Faults(Settings):
    """Faults of a drone's sensor and actuator; by default there are none.

    Raises:
        ConfigError: a number is out of its range.
    """

    noise: Annotated[AtLeast0, at_most(MOST_WHOLE)] = key(
        0.0, "standard deviation σ of each sensed distance", "px"
    )
    lost: Share = key(0.0, "of each sensed obstacle to be lost, independently", "probability")
    late: Whole = key(0, "by which each observation comes too late", "steps", ge=0, le=MOST_REMEMBERED)
    sticky: Share = key(0.0, "of the last executed action to be executed again", "probability")

    def __str__(self) -> str:
        """The faults that are not zero, as `noise=5,late=2`, or `none`."""
        found = [f"{name}={value:g}" for name, value in self if value]
        return ",".join(found) or "none"

    def sizes(self, n_slots: int) -> list[int]:
        """How many random numbers a row needs in a step: normal ones of noise, uniform of lost and sticky."""
        return [n_slots * (self.noise > 0), n_slots * (self.lost > 0), int(self.sticky > 0)]

    def disturbed(self, distance: Tensor, draws: Tensor) -> Tensor:
        """What is sensed of distances: d + σ ε, and infinite with probability `lost`, as of an empty slot.

        distance [S, *B] px, draws [*B, n] of `sizes` -> [S, *B] px.
        """
        normal, uniform, _ = draws.split(self.sizes(len(distance)), -1)  # type: ignore[no-untyped-call]
        if self.noise:
            distance = distance + self.noise * normal.movedim(-1, 0)
        if self.lost:
            distance = distance.masked_fill(uniform.movedim(-1, 0) < self.lost, math.inf)
        return distance

    def executed(self, action: Tensor, last: Tensor, steps: Tensor, draws: Tensor) -> Tensor:
        """The action that is executed: the last one again with probability `sticky`, not in an episode's
        first step.

        action, last [*B] int64, steps [*B] since the episode began, draws [*B, n] of `sizes` -> [*B]. Machado
        et al. (2018), "Revisiting the Arcade Learning Environment".
        """
        sticks = (draws[..., -1] < self.sticky) & (steps > 0)
        return last.where(sticks, action)


NO_FAULTS = Faults()

NAMES = Faults.names()


def from_words(words: str) -> Faults:
    """Faults from `noise=5,late=2`, or from `none`.

    Raises:
        ValueError: there is no such fault, or its value is not right.
    """
    values: dict[str, Any] = {}
    for word in words.split(",") if words != "none" else ():
        name, _, given = word.strip().partition("=")
        if name not in NAMES:
            raise unknown_key(name, NAMES)
        try:
            values[name] = int(given) if name == "late" else float(given)
        except ValueError:
            raise ConfigError(
                f"{told(word.strip())}; give a number, as noise=5, or whole steps, as late=2"
            ) from None
    return Faults(**values)


def from_option(words: str | None) -> Faults | None:
    """What a command's `--faults` asks for; None where it is not given.

    Raises:
        ValueError: as of `from_words`, and it names the option.
    """
    try:
        return None if words is None else from_words(words)
    except ValueError as error:
        raise ConfigError(f"--faults {told(words)}: {error}") from error
