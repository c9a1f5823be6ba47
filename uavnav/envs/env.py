"""DroneEnv: the world as a native TorchRL environment. Wiring only; the arithmetic is in `tasks`."""

from __future__ import annotations

import math
import numbers
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from uavnav.acting import Actor
from uavnav.errors import ConfigError, told
from uavnav.graph import Graph, Scan, parts
from uavnav.tasks.faults import Faults
from uavnav.tasks.seeding import Chance, places
from uavnav.tasks.state import COUNTS, UP, State, where
from uavnav.tasks.table import make_task
from uavnav.tasks.task import Outcome, Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

unchecked = TensorDict._new_unsafe
"""As TorchRL's own environments make theirs: checks would cost more than a small step."""

LEAVES = ("observation", "reward", "done", "terminated", "truncated")
N_LEAVES, N_COUNTS = len(LEAVES), 1 + len(COUNTS)


MOST_ROWS = 10_000_000  # of a batch


def _listed(name: str, value: Any) -> Sequence[Any]:
    """The entries of a sequence; raises a ConfigError for what is none."""
    value = value.tolist() if hasattr(value, "tolist") else value  # an array, or a tensor
    if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
        raise ConfigError(f"{name}={told(value)}; give whole numbers")
    return value


def _size(batch_size: Any) -> torch.Size:
    """A shape of rows; raises a ConfigError where it is none, or too large."""
    shape = _listed("batch_size", batch_size)
    if (
        not all(isinstance(one, numbers.Integral) and 1 <= int(one) <= MOST_ROWS for one in shape[:8])
        or len(shape) > 8
    ):
        raise ConfigError(f"batch_size={told(batch_size)}; give whole numbers above 0")
    if math.prod(shape) > MOST_ROWS:
        raise ConfigError(f"batch_size={told(batch_size)}; give at most {MOST_ROWS:,} rows")
    return torch.Size(shape)


def _device(device: Any) -> torch.device:
    """A device of torch; raises a ConfigError where this machine has none of that name."""
    try:
        torch.empty(0, device=device)
        return torch.device(device)
    except (AssertionError, ImportError, RuntimeError, TypeError, ValueError) as error:
        raise ConfigError(f"device={told(device)}; choose cpu, or a device that this machine has") from error


@dataclass
class Now:
    """What changes with every step; an attribute of TorchRL's environments takes long to set."""

    state: State
    observation: Tensor
    begins_here: bool  # the next reset of all rows leaves them where they are


class DroneEnv(EnvBase):  # type: ignore[misc]
    """A drone that must not hit anything, in a batch of independent environments.

    Action:
        `action` [*B] int64 in 0..99: ten turns times ten distances, eqs (11) and (12).
    Observation:
        `observation` [*B, 30] float32: ten triplets (right, forward, proximity), eq. (13); as many of the
        newest as `stack` says, the newest first.
    Reward:
        `reward` [*B, 1] float32: eq. (14), or another variant of `uavnav.rewards`.
    Start:
        The centre of the window, heading up; each row has a place of its own in the split and takes the next
        layout after each of its episodes.
    End:
        `terminated`: the drone touched an obstacle or the border, or reached its goal. `truncated`:
        `max_steps` was reached (never both).
    Episode:
        `("next", "episode", ...)` has the counts since the episode began (steps, stops, full_stops, turns,
        distance [px], reward) and its layout: on the last step of an episode they describe all of it.
    Version:
        `uavnav.world.VERSION`.

    Args:
        batch_size: any shape B; a training run uses [agents, environments].
        layouts: `train`, `validation`, `test`, a layout file's path, or a tensor [n, k, 3].
        world: constants and switches.
        max_steps: a time limit, or None as in the paper.
        reward: a name of `uavnav.rewards.REWARDS`; by default the task's own, eq14 of the paper's.
        task: a name of `uavnav.tasks.table.TASKS`; or a whole task, which then says all parts of it.
        device: where the tensors live.
        seeds: one seed for all rows, or one for each entry of the first batch dimension. A row depends on its
            seed and its index among that seed's rows, not on the other seeds.
        stack: newest observations that are seen at once.
        faults: of the sensor and the actuator (`uavnav.tasks.faults`).
        compile: TorchRL's own keyword: run the step as one compiled graph (`env.compile()`, `env.eager()`).

    Raises:
        LayoutError: the split cannot be read or is not valid.
        ValueError: an unknown reward, a time limit below 1, or seeds that do not fit the batch; in `step`, an
            action out of range (`step_and_maybe_reset`, the path of collectors and rollouts, trusts its
            policy).
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (),
        layouts: str | Path | Tensor = "train",
        world: World | None = None,
        max_steps: int | None = None,
        reward: str | None = None,
        device: str | torch.device = "cpu",
        seeds: int | Sequence[int] = 0,
        task: str | Task | WrappedTask = "drone",
        stack: int = 1,
        faults: Faults | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(device=_device(device), batch_size=_size(batch_size))
        whole = make_task(layouts, world, reward, max_steps, task, stack, faults)
        self.task = whole.replace(layouts=whole.layouts.to(self.device))
        self.world, self.layouts = self.task.world, self.task.layouts
        self._first = self._sense_starts()
        self.compiled, self._scans = False, dict[Actor, Scan]()
        self._advance: Callable[..., Sequence[Tensor]] = self._advance_rows
        self._make_specs()
        self._seed(seeds)

    @property
    def state(self) -> State:
        """Of every row, now."""
        return self._now.state

    def _make_specs(self) -> None:
        shape, world = self.batch_size, self.world
        low = torch.tensor(world.observation_low, device=self.device).repeat(self.task.stack)
        kind: dict[str, Any] = {"shape": shape, "device": self.device}
        episode = Composite(
            {name: Unbounded(dtype=torch.int64, **kind) for name in ("layout", *COUNTS[:-1])}, **kind
        )
        episode["reward"] = Unbounded(dtype=torch.float64, **kind)
        self.observation_spec = Composite(
            observation=Bounded(
                low.expand(*shape, -1),
                torch.ones_like(low).expand(*shape, -1),
                device=self.device,
                dtype=torch.float32,
            ),
            episode=episode,
            **kind,
        )
        self.action_spec = Categorical(world.n_actions, **kind)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32, device=self.device)
        flag = Categorical(2, shape=(*shape, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), **kind)

    # -- randomness: streams of places, headings and faults for each seed ------------------------------------

    def _seed(self, seeds: int | Sequence[int]) -> None:
        one = isinstance(seeds, numbers.Integral)
        given: Sequence[Any] = [seeds] if one else _listed("seeds", seeds)
        if not all(isinstance(seed, numbers.Integral) for seed in given):
            raise ConfigError(f"seeds={told(seeds)}; give a whole number, or one per agent")
        self.seeds = [operator.index(seed) for seed in given]
        if not one and (not self.batch_size or len(self.seeds) != self.batch_size[0]):
            raise ValueError(
                f"{len(self.seeds)} seeds for batch_size {list(self.batch_size)}; give one, or one per agent"
            )
        rows = self.batch_size.numel() // len(self.seeds)
        layout = places(self.seeds, rows, len(self.layouts), self.device)
        self._chance = Chance(self.task, self.seeds, self.batch_size, self.device)
        self._never = torch.zeros((), dtype=torch.bool, device=self.device).expand(*self.batch_size, 1)
        state = self._start(layout.reshape(self.batch_size))
        self._now = Now(state, self.task.observe(state)[0], begins_here=True)

    def _set_seed(self, seed: int | None) -> None:
        """TorchRL's hook: as constructing with `seeds=seed`, or with seed, seed + 1, ... of agents."""
        first = 0 if seed is None else seed
        self._seed(first if len(self.seeds) == 1 else [first + agent for agent in range(len(self.seeds))])

    def _sense_starts(self) -> list[Tensor]:
        """By layout, the first observation of an episode [L, 30]; with a memory the first scan, which faults
        disturb.

        Nothing where start headings are random.
        """
        if self.world.start_heading != "up":
            return []
        layout = torch.arange(len(self.layouts), device=self.device)
        start = self.task.task.start(layout, 0 * layout + UP)
        return [*self.task.sense(start)[0]] if self.task.remembers else [self.task.observe(start)[0]]

    def _start(self, layout: Tensor) -> State:
        """Where episodes of every row begin: layout [*B]."""
        return self.task.start(layout, *self._chance.start())

    def state_dict(self) -> dict[str, Any]:
        """All that the future depends on: rows' states and observations, streams of headings and faults."""
        state = {name: value.clone() for name, value in self._now.state._asdict().items()}
        return {"state": state, "observation": self._now.observation.clone(), **self._chance.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from where `state_dict` was taken, in an environment built alike, also at the next reset."""
        fields = {name: value.to(self.device).clone() for name, value in state_dict["state"].items()}
        self._now.state = self.task.state_class(**fields)
        self._now.observation = state_dict["observation"].to(self.device).clone()
        self._chance.load_state_dict(state_dict)
        self._now.begins_here = True

    # -- TorchRL's protocol ----------------------------------------------------------------------------------

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        if chosen is not None:
            chosen = chosen.reshape(self.batch_size)
        if chosen is not None or not self._now.begins_here:
            fresh = self._start((self._now.state.layout + 1) % len(self.layouts))
            self._now.state = fresh if chosen is None else where(chosen, fresh, self._now.state)
            self._now.observation, _ = self.task.observe(self._now.state)
        self._now.begins_here = False
        return self.root()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        if bool(((action < 0) | (action >= self.world.n_actions)).any()):
            raise ValueError(
                f"action={action.tolist()}; give whole numbers from 0 to {self.world.n_actions - 1}"
            )
        self._now.state, outcome = self.task.step(self._now.state, action, self._chance.step())
        self._now.observation, self._now.begins_here = outcome.observation, False
        return self._tensordict(_leaves(outcome), self._now.state)

    @torch.no_grad()
    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """One step of every row, and the next episode's start where one ended, as TorchRL's own in one go."""
        later, (headings, first) = self._chance.step(), self._chance.start()
        given = (tensordict.get("action"), headings, self.layouts, *self._first)
        found = self._advance(*self._now.state, *given, *(one for one in (later, first) if one is not None))
        bare = self.task.STATE
        leaves, final, (observation, *state) = parts(found, N_LEAVES, len(bare._fields))
        self.go_on([*state, observation])
        tensordict.set("next", self._tensordict(dict(zip(LEAVES, leaves, strict=True)), bare(*final)))
        return tensordict, self.root()

    def compile(self) -> DroneEnv:
        """Run the steps of all rows as compiled graphs; TorchRL's own would trace the TensorDicts around them
        too.

        The task is then that of the first step.
        """
        self._advance, self.compiled, self._scans = Graph(self._advance_rows), True, {}
        return self

    def eager(self) -> DroneEnv:
        """Undo `compile`."""
        self._advance, self.compiled = self._advance_rows, False
        return self

    def rollout(self, max_steps: int, policy: Any = None, *args: Any, **how: Any) -> TensorDictBase:
        """TorchRL's; unbroken steps of an `Actor` are one graph where the environment is compiled."""
        plain = type(policy) is Actor and not args and how == {"break_when_any_done": False}
        if not (self.compiled and plain):
            return super().rollout(max_steps, policy, *args, **how)
        self.reset()
        return self.steps(policy, max_steps)

    @torch.no_grad()
    def steps(self, actor: Actor, n: int) -> TensorDict:
        """Steps of an actor from where the environment is, as one compiled graph: [*B, n], as a collector's.

        actor: of this environment's agents, whose batch is [agents, environments].
        """
        inputs = self.draw(actor, n)
        found = self.scan(actor, len(inputs))(*self.tensors, *inputs, *self.constants, *actor.weights)
        n_state = len(self.tensors)
        self.go_on(found[:n_state])
        return self.batch(found[n_state:])

    @property
    def tensors(self) -> list[Tensor]:
        """Where the environment is: the fields of its state, and the observation."""
        return [*self._now.state, self._now.observation]

    @property
    def constants(self) -> list[Tensor]:
        """What each step is given: layouts, and where it is known, what is sensed first on each."""
        return [self.layouts, *self._first]

    def draw(self, actor: Actor, n: int) -> list[Tensor]:
        """All random numbers of an actor's next n steps and their episodes, [n, ...] each."""
        _, environments = self.batch_size
        return [*actor.draw(n, environments), *self._chance.steps(n)]

    def scan(self, actor: Actor, n_inputs: int) -> Scan:
        """Steps of an actor: `tensors`, what `draw` gives, `constants` and the actor's weights -> the next
        `tensors`, then what `batch` takes.
        """
        return self._scans.get(actor) or self._scans.setdefault(actor, self._scan(actor, n_inputs))

    def whole(self, actor: Actor) -> bool:
        """Whether the actor's steps were found to run as one graph."""
        return self.compiled and actor in self._scans and self._scans[actor].whole

    def go_on(self, tensors: Sequence[Tensor]) -> None:
        """Go on from other `tensors`."""
        *state, self._now.observation = tensors
        self._now.state, self._now.begins_here = self.task.state_class(*state), False

    def batch(self, outputs: Sequence[Tensor]) -> TensorDict:
        """What `scan` gives of n steps, as a collector does: [*B, n]."""
        action, observation, *rows = outputs
        never = self._never[..., None, :].expand(*action.shape, 1)
        flags = dict.fromkeys(("done", "terminated", "truncated"), never)
        following = dict(zip(LEAVES, rows[N_COUNTS:-N_COUNTS], strict=True))
        root = {"observation": observation, "action": action, **flags}
        root["next"] = self._batch(following, rows[-N_COUNTS:])
        return self._batch(root, rows[:N_COUNTS])

    def _scan(self, actor: Actor, n_inputs: int) -> Scan:
        n_state, n_given = len(self.task.state_class._fields), len(self.constants)
        counted = [self.task.state_class._fields.index(name) for name in ("layout", *COUNTS)]

        def step(*tensors: Tensor) -> Sequence[Tensor]:
            state, (observation,), inputs, given, weights = parts(tensors, n_state, 1, n_inputs, n_given)
            uniform, epsilon, heading, *draws = inputs
            (action,) = actor.choose(observation, uniform, epsilon, *weights)
            found = self._advance_rows(*state, action, heading, *given, *reversed(draws))
            leaves, final, (seen, *following) = parts(found, N_LEAVES, len(self.task.STATE._fields))
            before = [action, observation, *(state[field] for field in counted)]
            return *following, seen, *before, *leaves, *(final[field] for field in counted)

        return Scan(step, n_state + 1, n_inputs, time=2, cpp_wrapper=self.device.type == "cpu")

    def _advance_rows(self, *tensors: Tensor) -> Sequence[Tensor]:
        """State, action, start headings, layouts, then what is sensed first, and draws -> the step's leaves,
        its state without what it remembers, where to go on.
        """
        kind = self.task.state_class
        before, (action, heading, layouts), known, draws = parts(
            tensors, len(kind._fields), 3, len(self._first)
        )
        later, first = draws or (None, None)
        task = self.task.replace(layouts=layouts)
        final, outcome = task.step(kind(*before), action, later)
        done = outcome.terminated | outcome.truncated
        # compared below: a remainder would divide for each number that is looked up
        following = final.layout + 1
        following = torch.where(following < layouts.shape[0], following, 0)
        fresh = task.start(following, heading, first, *(known if task.remembers else ()))
        state = where(done, fresh, final)
        if task.remembers:
            observation = task.recall(state)
        elif self._first:
            observation = torch.where(done[..., None], known[0][fresh.layout], outcome.observation)
        else:
            observation, _ = task.observe(state)
        return *_leaves(outcome).values(), *final[: len(task.STATE._fields)], observation, *state

    def root(self) -> TensorDict:
        """What the next step starts from: the observation, flags and counts of now."""
        flags = dict.fromkeys(("done", "terminated", "truncated"), self._never)
        return self._tensordict({"observation": self._now.observation, **flags}, self._now.state)

    def _tensordict(self, leaves: dict[str, Tensor], state: State) -> TensorDict:
        return self._batch(leaves, [getattr(state, name) for name in ("layout", *COUNTS)])

    def _batch(self, leaves: dict[str, Any], counts: Sequence[Tensor]) -> TensorDict:
        """Leaves and counts of rows [*B], or of steps [*B, T], as TorchRL has them."""
        kind: dict[str, Any] = {"batch_size": counts[0].shape, "device": self.device}
        episode = dict(zip(("layout", *COUNTS), counts, strict=True))
        return unchecked({**leaves, "episode": unchecked(episode, **kind)}, **kind)


def _leaves(outcome: Outcome) -> dict[str, Tensor]:
    """What TorchRL wants to know of a step, in its shapes and types."""
    terminated, truncated = outcome.terminated[..., None], outcome.truncated[..., None]
    reward = outcome.reward[..., None].float()
    return dict(
        zip(LEAVES, (outcome.observation, reward, terminated | truncated, terminated, truncated), strict=True)
    )
