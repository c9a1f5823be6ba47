"""How policies are evaluated, and the file that keeps the rows of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from uavnav.tasks.protocol import EPISODES, LIMITS, MAX_STEPS, SPLITS

if TYPE_CHECKING:
    from uavnav.tasks.faults import Faults


class Protocol(NamedTuple):
    """How policies are evaluated: on the first layouts of a layout file, until a time limit, with faults."""

    layouts: str | Path = "test"
    episodes: int = EPISODES
    max_steps: int = MAX_STEPS
    faults: Faults | None = None  # None: the task's own
    task: str = "drone"  # of a scripted policy; a run knows its own
    at: float | None = None  # the share of training after which the policies were kept; None: its end
    shield: bool = False  # whether all actions go through `tasks.shield`

    def file(self, name: str) -> str:
        """The file of a policy's rows: `evaluation.parquet` of the usual protocol, others with their parts,
        such as `evaluation-test-200-10000-noise=5.parquet`.
        """
        parts: list[Any] = [] if self.at is None else [f"at-{self.at:g}"]
        parts += [self.task] * (self.task != "drone") + [self._layouts(), self.episodes, self.max_steps]
        parts += [self.faults] * (self.faults is not None) + ["shielded"] * self.shield
        usual = self._replace(layouts=str(self.layouts)) == Protocol()
        return "-".join(map(str, [name, *([] if usual else parts)])) + ".parquet"

    def _layouts(self) -> str:
        if self.layouts in SPLITS:
            return str(self.layouts)
        from uavnav.tasks.layouts import name_of  # brings torch

        return name_of(self.layouts)

    def header(self) -> dict[Any, Any]:
        """What the header of that file says; of a task, if it is not the paper's."""
        said = {
            "layouts": str(self.layouts),
            "episodes": self.episodes,
            "max_steps": self.max_steps,
            "faults": None if self.faults is None else str(self.faults),
            "at": self.at,
            "shield": self.shield or None,
            "task": None if self.task == "drone" else self.task,
        }
        return {name: value for name, value in said.items() if value is not None}


def usual(task: str) -> Protocol:
    """How a run of a task is evaluated if nothing else is said, of a task of the package."""
    return Protocol(max_steps=LIMITS.get(task, MAX_STEPS))
