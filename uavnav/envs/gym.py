"""The world for Gymnasium: one drone (`DroneGymEnv`, in plain numbers) or many at once (`DroneVectorEnv`, in tensors).

Registered as `uavnav/Drone-v0`: `gymnasium.make` gives the one, `gymnasium.make_vec` the other.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from uavnav.envs.drawing import draw_state
from uavnav.envs.scalar import Flight
from uavnav.tasks import layouts as banks
from uavnav.tasks import seeding, simulator
from uavnav.tasks.simulator import UP, State
from uavnav.tasks.world import World

Observation = np.ndarray[Any, np.dtype[np.floating[Any] | np.integer[Any]]]
Info = dict[str, Any]

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}


def observation_space(world: World) -> spaces.Box:
    """Ten triplets in [-1, 1] x [0, 1] x [0, 1], eq. (13)."""
    low = np.tile(np.array([-1, 0, 0], dtype=np.float32), world.n_slots)
    return spaces.Box(low, np.ones_like(low), dtype=np.float32)


def pick(layout: Any, shape: tuple[int, ...], n_layouts: int) -> np.ndarray[Any, Any]:
    """The layout that a reset's options name: one index, or one for each row of `shape`.

    Raises:
        ValueError: it is not one of the bank's.
    """
    chosen = np.asarray(layout)
    fits = chosen.dtype.kind in "iu" and chosen.shape in ((), shape)
    if not fits or not ((chosen >= 0) & (chosen < n_layouts)).all():
        raise ValueError(f"options layout={layout}; give a whole number from 0 to {n_layouts - 1}")
    return chosen


class _Flights:
    """A batch of rows, each flying its own set of obstacles: the vector environment in tensors."""

    def __init__(
        self,
        num_envs: int,
        layouts: str | Path | Tensor,
        world: World | None,
        max_steps: int | None,
        reward: str,
    ) -> None:
        simulator.check_rules(reward, max_steps)
        self.world = world or World()
        self.bank = banks.resolve(layouts, self.world).cpu()
        self.max_steps, self.reward = max_steps, reward
        self.shape = torch.Size([num_envs])
        self.state: State | None = None

    def seed(self, seeds: Sequence[int]) -> None:
        """Put every row at its place: all rows are one seed's, or each row is a seed's first."""
        rows = self.shape.numel() // len(seeds)
        self._n_seeds, self._streams = len(seeds), seeding.Streams(seeds, "headings")
        self._first = seeding.places(seeds, rows, len(self.bank), "cpu").reshape(self.shape)
        self.state = None

    def reset(self, layout: Any = None) -> None:
        """Start every row on its next set, or on the given ones."""
        following = self._first if self.state is None else (self.state.layout + 1) % len(self.bank)
        if layout is not None:
            chosen = torch.as_tensor(pick(layout, tuple(self.shape), len(self.bank)), dtype=torch.int64)
            following = chosen.expand(self.shape).clone()
        self.state = simulator.start(following, self._headings(), self.world)

    def step(self, action: Any) -> simulator.Outcome:
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        given = np.asarray(action)
        fits = given.dtype.kind in "iu" and given.size == self.shape.numel()
        if not fits or not ((given >= 0) & (given < self.world.n_actions)).all():
            raise ValueError(
                f"action={action}; give a whole number from 0 to {self.world.n_actions - 1} for each of the"
                f" {self.shape.numel()} rows"
            )
        actions = torch.as_tensor(given, dtype=torch.int64).reshape(self.shape)
        self.state, outcome = simulator.step(self.state, actions, self.bank, self.world, self.reward, self.max_steps)
        return outcome

    def restart(self, done: Tensor) -> None:
        """Start the next episode where one ended."""
        assert self.state is not None
        fresh = simulator.start((self.state.layout + 1) % len(self.bank), self._headings(), self.world)
        self.state = simulator.where(done, fresh, self.state)

    def observe(self) -> tuple[Tensor, Tensor]:
        assert self.state is not None
        return simulator.observe(self.state, self.bank, self.world)

    def _headings(self) -> Tensor:
        if self.world.start_heading == "up":
            return torch.full(self.shape, UP)
        rows = self.shape.numel() // self._n_seeds
        return seeding.headings(self._streams, rows, "cpu").reshape(self.shape)


class DroneGymEnv(gymnasium.Env[Observation, np.int64]):
    """One drone that must not hit anything.

    Action:
        Discrete(100): ten turns times ten distances, eqs (11) and (12).
    Observation:
        Box of 30 float32: ten triplets (right, forward, distance), eq. (13).
    Reward:
        Eq. (14), or another variant of `uavnav.rewards`.
    Start:
        The centre of the window, heading up. `reset(seed=...)` fixes the place in the bank, every later reset takes
        the next set, and `reset(options={"layout": 3})` picks one.
    End:
        `terminated`: the drone touched an obstacle or the border. `truncated`: `max_steps` was reached.
    Info:
        layout (index), x, y (px), heading (degrees), clearance (px to the nearest obstacle or border square).

    Raises:
        LayoutError, ValueError: a bad bank, reward, cap, layout or action.
    """

    metadata = METADATA

    def __init__(
        self,
        layouts: str | Path | Tensor = "train",
        world: World | None = None,
        max_steps: int | None = None,
        reward: str = "eq14",
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *METADATA["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r}; choose None or rgb_array")
        simulator.check_rules(reward, max_steps)
        self.world = world or World()
        self.bank = banks.resolve(layouts, self.world).cpu()
        self.render_mode = render_mode
        self.observation_space = observation_space(self.world)
        self.action_space = spaces.Discrete(self.world.n_actions)
        self._flight = Flight(self.bank, self.world, reward, max_steps)
        self._layout: int | None = None  # of the present episode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        chosen = (options or {}).get("layout")
        if chosen is not None:
            chosen = int(pick(chosen, (), len(self.bank)))
        super().reset(seed=seed)
        if seed is not None or self._layout is None:
            seeds = [int(self.np_random.integers(2**31)) if seed is None else seed]
            self._streams = seeding.Streams(seeds, "headings")
            following = int(seeding.places(seeds, 1, len(self.bank), "cpu"))
        else:
            following = (self._layout + 1) % len(self.bank)
        self._layout = following if chosen is None else chosen
        random = self.world.start_heading == "random"
        heading = int(seeding.headings(self._streams, 1, "cpu")) if random else UP
        return self._flight.start(self._layout, heading), self._info()

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, Info]:
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        try:
            index = operator.index(np.asarray(action).reshape(())[()])
        except (TypeError, ValueError):
            index = -1
        if not 0 <= index < self.world.n_actions:
            raise ValueError(f"action={action}; give a whole number from 0 to {self.world.n_actions - 1}")
        return *self._flight.step(index), self._info()

    def render(self) -> np.ndarray[Any, np.dtype[np.uint8]] | None:
        """The picture [600, 800, 3] of the present state, with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without render_mode="rgb_array"')
            return None
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        flight = self._flight
        state = simulator.start(torch.tensor(flight.layout), torch.tensor(flight.heading), self.world)
        state = state._replace(x=torch.tensor(flight.x), y=torch.tensor(flight.y))
        return draw_state(state, self.bank, self.world)

    def _info(self) -> Info:
        flight = self._flight
        return {name: getattr(flight, name) for name in ("layout", "x", "y", "heading", "clearance")}


class DroneVectorEnv(VectorEnv[Observation, np.ndarray[Any, np.dtype[np.int64]], Any]):
    """Many drones in one batch, as `DroneGymEnv` each; an episode that ends is followed by the next in the same step.

    `reset(seed=s)` makes the rows the parallel worlds of seed s, each at a place of its own; a list gives each row a
    seed. At the end of an episode the observation is the next one's first, and the info's `final_obs` and
    `final_info` hold the last of the one that ended. The layout of `reset(options={"layout": ...})` is one number or
    one a row.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        layouts: str | Path | Tensor = "train",
        world: World | None = None,
        max_steps: int | None = None,
        reward: str = "eq14",
        render_mode: str | None = None,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs}; give at least 1")
        if render_mode not in (None, *METADATA["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r}; choose None or rgb_array")
        self._flights = _Flights(num_envs, layouts, world, max_steps, reward)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode.SAME_STEP
        self.single_observation_space = observation_space(self._flights.world)
        self.single_action_space = spaces.Discrete(self._flights.world.n_actions)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._seeded = False

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(f"{len(seed)} seeds for {self.num_envs} environments; give one, or one for each")
            draws = [int(self.np_random.integers(2**31)) if one is None else operator.index(one) for one in seed]
            if min(draws) < 0:
                raise ValueError(f"seed={list(seed)}; give whole numbers of at least 0, or None")
            self._flights.seed(draws)
        elif seed is not None or not self._seeded:
            super().reset(seed=seed)
            self._flights.seed([int(self.np_random.integers(2**31)) if seed is None else seed])
        self._seeded = True
        self._flights.reset((options or {}).get("layout"))
        observation, clearance = self._flights.observe()
        return observation.numpy(), self._info(clearance)

    def step(
        self, actions: np.ndarray[Any, np.dtype[np.int64]]
    ) -> tuple[Observation, np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any], Info]:
        outcome = self._flights.step(actions)
        observation, clearance = outcome.observation, outcome.clearance
        done = outcome.terminated | outcome.truncated
        final = self._info(clearance)
        info = {}
        if done.any():
            ended = done.numpy()
            final_observations = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(ended):
                final_observations[row] = observation[row].numpy()
            masked = {key: np.where(ended, value, 0) for key, value in final.items() if not key.startswith("_")}
            masks = {f"_{key}": ended.copy() for key in masked}
            info = {"final_obs": final_observations, "final_info": masked | masks}
            info |= {"_final_obs": ended.copy(), "_final_info": ended.copy()}
            self._flights.restart(done)
            observation, clearance = self._flights.observe()
        return (
            observation.numpy(),
            outcome.reward.numpy(),
            outcome.terminated.numpy(),
            outcome.truncated.numpy(),
            self._info(clearance) | info,
        )

    def render(self) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], ...] | None:
        """One picture [600, 800, 3] a row, with `render_mode="rgb_array"`."""
        state = self._flights.state
        if self.render_mode is None or state is None:
            return None
        rows = [State(*(field[row] for field in state)) for row in range(self.num_envs)]
        return tuple(draw_state(row, self._flights.bank, self._flights.world) for row in rows)

    def _info(self, clearance: Tensor) -> Info:
        state = self._flights.state
        assert state is not None
        values = {name: getattr(state, name).numpy().copy() for name in ("layout", "x", "y", "heading")}
        values["clearance"] = clearance.numpy().copy()
        return values | {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in values}
