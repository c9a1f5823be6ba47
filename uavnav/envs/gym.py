"""The environment for Gymnasium: one drone (`DroneGymEnv`, in plain numbers) or a batch (`DroneVectorEnv`, in
tensors).

Both are registered as `uavnav/Drone-v0`: `gymnasium.make` returns the first, and `gymnasium.make_vec` the
second. Other tasks have names of their own, such as `uavnav/Moving-v0`; every field of a world is a keyword:
`speed_max=3.0`.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from uavnav.envs import scalar
from uavnav.envs.drawing import STEPS_PER_SECOND, draw_state
from uavnav.envs.env import MOST_ROWS
from uavnav.envs.viewer import Viewer
from uavnav.errors import ConfigError, among, quoted, told
from uavnav.settings import Settings
from uavnav.tasks.faults import NAMES, Faults
from uavnav.tasks.seeding import Chance, places
from uavnav.tasks.state import State, at, where
from uavnav.tasks.table import make_task
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

Observation = np.ndarray[Any, np.dtype[np.floating[Any] | np.integer[Any]]]
Info = dict[str, Any]

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": STEPS_PER_SECOND}
MODES = ("human", "rgb_array")
"""How one drone is shown: in a window, or as an array."""


def observation_space(world: World, stack: int = 1) -> spaces.Box:
    """A Box of what the drone senses: ten triplets in [-1, 1] x [0, 1] x [0, 1], eq. (13), or a stack."""
    low = np.tile(np.array(world.observation_low, dtype=np.float32), stack)
    return spaces.Box(low, np.ones_like(low), dtype=np.float32)


def _task(
    layouts: str | Path | Tensor,
    world: World | None,
    reward: str | None,
    max_steps: int | None,
    task: str | Task | WrappedTask,
    stack: int,
    faults: Faults | Mapping[str, Any] | None,
    fields: Mapping[str, Any],
) -> WrappedTask:
    """The task of an environment, on the CPU, from its keywords; fields: of its world, and of its faults."""
    if fields and not isinstance(task, str):
        raise ValueError(f"{next(iter(fields))}=...: a whole task has a world; give no fields with it")
    of_faults = {name: value for name, value in fields.items() if name in NAMES}
    of_world = {name: value for name, value in fields.items() if name not in NAMES}
    world, faults = _changed(world, of_world), _changed(faults, of_faults)
    whole = make_task(layouts, world, reward, max_steps, task, stack, faults)
    return whole.replace(layouts=whole.layouts.cpu())


def _changed(given: Any, fields: Mapping[str, Any]) -> Any:
    """Settings, or a mapping of some, with these fields instead."""
    if not fields:
        return given
    return {**(given.model_dump() if isinstance(given, Settings) else given or {}), **fields}


def chosen_layouts(options: Any, shape: tuple[int, ...], n_layouts: int) -> np.ndarray[Any, Any] | None:
    """The layouts in the options given to `reset`: one index, or one index per row of `shape`; or None.

    Raises:
        ConfigError: the options are no mapping.
        ValueError: an index is not in the split.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(f"options={told(options)}; give a mapping, such as {{'layout': 3}}")
    if (layout := (options or {}).get("layout")) is None:
        return None
    try:
        long = isinstance(layout, range) and (len(layout),) != shape
        chosen = np.array(-1) if long else np.asarray(layout)
    except (TypeError, ValueError, RuntimeError):  # ragged or deep lists
        chosen = np.array(-1)
    fits = chosen.dtype.kind in "iu" and chosen.shape in ((), shape)
    if not fits or not ((chosen >= 0) & (chosen < n_layouts)).all():
        raise ValueError(f"options layout={told(layout)}; give a whole number from 0 to {n_layouts - 1}")
    return chosen


class _Surroundings:
    """What is around the drone now; of a batch, with the axis of its rows in front."""

    task: WrappedTask

    def _now(self) -> State:
        raise NotImplementedError

    @property
    def obstacles(self) -> np.ndarray[Any, Any]:
        """The obstacles as they are now: [k, 3] of (x, y, radius) px."""
        return self.task.task.obstacles(self._now()).numpy().copy()  # where they stand still, the split's own

    @property
    def velocities(self) -> np.ndarray[Any, Any]:
        """Where they move: [k, 2] px a step."""
        return self.task.task.velocities(self._now()).numpy().copy()


class DroneGymEnv(_Surroundings, gymnasium.Env[Observation, np.int64]):
    """One drone that must avoid obstacles.

    Action:
        Discrete(100): ten turns times ten distances, eqs (11) and (12).
    Observation:
        Box of 30 float32: ten triplets (right, forward, proximity), eq. (13); of `stack` such, the newest
            first.
    Reward:
        Eq. (14), or another variant of `uavnav.rewards`.
    Start:
        The centre of the window, heading up. `reset(seed=...)` chooses the first layout of the split, every
        later reset takes the next layout, and `reset(options={"layout": 3})` takes layout 3.
    End:
        `terminated`: the drone touched an obstacle or the border, or reached its goal. `truncated`:
        `max_steps` was reached.
    Info:
        layout (index), x, y (px), heading (degrees), clearance (px to the nearest obstacle or border square);
        and what the task adds (`Task.info`).

    `fields` are those of the task's world. `obstacles` [k, 3] px and `velocities` [k, 2] px a step are those
    of now.

    Raises:
        LayoutError, ValueError: a bad layout file, reward, time limit, layout or action.
    """

    metadata = METADATA | {"render_modes": list(MODES)}

    def __init__(
        self,
        layouts: str | Path | Tensor = "train",
        world: World | None = None,
        max_steps: int | None = None,
        reward: str | None = None,
        render_mode: str | None = None,
        task: str | Task | WrappedTask = "drone",
        stack: int = 1,
        faults: Faults | Mapping[str, Any] | None = None,
        **fields: Any,
    ) -> None:
        if render_mode is not None and not among(render_mode, MODES):
            raise ValueError(f"render_mode={quoted(render_mode)}; choose None, {' or '.join(MODES)}")
        self.task = _task(layouts, world, reward, max_steps, task, stack, faults, fields)
        self._viewer = Viewer(METADATA["render_fps"]) if render_mode == "human" else None
        self.world, self.layouts = self.task.world, self.task.layouts
        self.render_mode = render_mode
        self.observation_space = observation_space(self.world, self.task.stack)
        self.action_space = spaces.Discrete(self.world.n_actions)
        self._episode = scalar.fly(self.task)
        self._layout: int | None = None  # of the present episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        chosen = chosen_layouts(options, (), len(self.layouts))
        super().reset(seed=seed)
        if seed is not None or self._layout is None:
            seeds = [int(self.np_random.integers(2**31)) if seed is None else seed]
            self._chance = Chance(self.task, seeds, (), "cpu")
            following = int(places(seeds, 1, len(self.layouts), "cpu"))
        else:
            following = (self._layout + 1) % len(self.layouts)
        self._layout = following if chosen is None else int(chosen)
        heading, draws = self._chance.start()
        started = self._episode.start(self._layout, int(heading), draws), self._info()
        self._show()
        return started

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, Info]:
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        try:
            index = operator.index(np.asarray(action).reshape(())[()])
        except (TypeError, ValueError):
            index = -1
        if not 0 <= index < self.world.n_actions:
            raise ValueError(
                f"action={told(action)}; give a whole number from 0 to {self.world.n_actions - 1}"
            )
        stepped = *self._episode.step(index, self._chance.step()), self._info()
        self._show()
        return stepped

    def _show(self) -> None:
        if self._viewer:
            self._viewer.show(draw_state(self._now(), self.task))

    def close(self) -> None:
        if self._viewer:
            self._viewer.close()

    def render(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """The picture of now, with `render_mode="rgb_array"`: [600, 800, 3], in 3D [600, 1608, 3]."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without render_mode="rgb_array"')
            return None
        if self._viewer:  # every reset and step has been shown
            return None
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        return draw_state(self._now(), self.task)

    def _now(self) -> State:
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._episode.state

    def _info(self) -> Info:
        return self._episode.info() | {"clearance": self._episode.clearance}


class DroneVectorEnv(_Surroundings, VectorEnv[Observation, np.ndarray[Any, np.dtype[np.int64]], Any]):
    """A batch of drones, each as in `DroneGymEnv`; when an episode ends, the next one starts in the same
    step.

    `reset(seed=s)` makes the rows the parallel environments of seed s, each with its own first layout; a list
    gives each row its own seed. `reset(options={"layout": ...})` takes one index, or one index per row. When
    an episode ends, `step` returns the next episode's first observation, and `final_obs` and `final_info` of
    the info describe the last state of the ended episode. `obstacles` and `velocities` have an axis more than
    one drone's: [num_envs, k, 3 or 2].
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        layouts: str | Path | Tensor = "train",
        world: World | None = None,
        max_steps: int | None = None,
        reward: str | None = None,
        render_mode: str | None = None,
        task: str | Task | WrappedTask = "drone",
        stack: int = 1,
        faults: Faults | Mapping[str, Any] | None = None,
        **fields: Any,
    ) -> None:
        if not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise ValueError(f"num_envs={told(num_envs)}; give at least 1")
        if num_envs > MOST_ROWS:
            raise ValueError(f"num_envs={told(num_envs)}; give at most {MOST_ROWS:,}")
        if render_mode is not None and not among(render_mode, METADATA["render_modes"]):
            raise ValueError(f"render_mode={quoted(render_mode)}; choose None or rgb_array")
        self.task = _task(layouts, world, reward, max_steps, task, stack, faults, fields)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode.SAME_STEP
        self.single_observation_space = observation_space(self.task.world, self.task.stack)
        self.single_action_space = spaces.Discrete(self.task.world.n_actions)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._seeded: bool = False
        self._state: State | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        chosen = chosen_layouts(options, (self.num_envs,), len(self.task.layouts))
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(
                    f"{len(seed)} seeds for {self.num_envs} environments; give one, or one for each"
                )
            draws = [
                int(self.np_random.integers(2**31)) if one is None else operator.index(one) for one in seed
            ]
            if min(draws) < 0:
                raise ValueError(f"seed={list(seed)}; give whole numbers of at least 0, or None")
            self._seed_rows(draws)
        elif seed is not None or not self._seeded:
            super().reset(seed=seed)
            self._seed_rows([int(self.np_random.integers(2**31)) if seed is None else seed])
        following = self._first if self._state is None else (self._state.layout + 1) % len(self.task.layouts)
        if chosen is not None:
            following = torch.as_tensor(chosen, dtype=torch.int64).expand(self.num_envs).clone()
        self._state = self._start(following)
        observation, clearance = self.task.observe(self._state)
        return observation.numpy(), self._info(self._state, clearance)

    def step(
        self, actions: np.ndarray[Any, np.dtype[np.int64]]
    ) -> tuple[Observation, np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any], Info]:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        given, n_actions = np.asarray(actions), self.task.world.n_actions
        fits = given.dtype.kind in "iu" and given.size == self.num_envs
        if not fits or not ((given >= 0) & (given < n_actions)).all():
            whole = f"give a whole number from 0 to {n_actions - 1} for each of the {self.num_envs} rows"
            raise ValueError(f"action={told(actions)}; {whole}")
        action = torch.as_tensor(given, dtype=torch.int64).reshape(self.num_envs)
        state, outcome = self.task.step(self._state, action, self._chance.step())
        observation, clearance = outcome.observation, outcome.clearance
        done = outcome.terminated | outcome.truncated
        info = {}
        if done.any():
            ended = done.numpy()
            final_observations = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(ended):
                final_observations[row] = observation[row].numpy()
            info = {
                "final_obs": final_observations,
                "final_info": self._info(state, clearance, ended),
                "_final_obs": ended.copy(),
                "_final_info": ended.copy(),
            }
            fresh = self._start((state.layout + 1) % len(self.task.layouts))
            state = where(done, fresh, state)
            observation, clearance = self.task.observe(state)
        self._state = state
        return (
            observation.numpy(),
            outcome.reward.numpy(),
            outcome.terminated.numpy(),
            outcome.truncated.numpy(),
            self._info(state, clearance) | info,
        )

    def render(self) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], ...] | None:
        """One picture a row, with `render_mode="rgb_array"`: [600, 800, 3], in 3D [600, 1608, 3]."""
        if self.render_mode is None or self._state is None:
            return None
        return tuple(draw_state(at(self._state, row), self.task) for row in range(self.num_envs))

    def _seed_rows(self, seeds: Sequence[int]) -> None:
        """Choose every row's first layout: all rows share one seed, or each row has its own."""
        rows = self.num_envs // len(seeds)
        self._chance = Chance(self.task, seeds, (self.num_envs,), "cpu")
        self._first = places(seeds, rows, len(self.task.layouts), "cpu").flatten()
        self._seeded, self._state = True, None

    def _start(self, layout: Tensor) -> State:
        return self.task.start(layout, *self._chance.start())

    def _now(self) -> State:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._state

    def _info(self, state: State, clearance: Tensor, rows: Any = True) -> Info:
        """What is told of some rows, and which these are; of the others zeros."""
        values = {**self.task.info(state), "clearance": clearance}
        shown = {name: np.where(rows, value, torch.zeros_like(value)) for name, value in values.items()}
        return shown | {f"_{name}": np.full(self.num_envs, rows) for name in values}
