"""The batched environment as a VecEnv; Stable-Baselines3 does not accept a Gymnasium VectorEnv.

The module needs the extra `sb3`. `PPO("MlpPolicy", DroneVecEnv(num_envs=16))` trains in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from uavnav.envs.gym import DroneVectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError("uavnav.sb3 needs Stable-Baselines3: pip install 'uavnav[sb3]'") from error


AROUND = ("obstacles", "velocities")  # attributes of a `DroneVectorEnv` with an axis of its rows in front


class DroneVecEnv(VecEnv):  # type: ignore[misc]
    """A VecEnv around `uavnav.gym.DroneVectorEnv`; `kwargs` are that class's keyword arguments."""

    def __init__(self, num_envs: int = 1, seed: int | None = None, **kwargs: Any) -> None:
        self._env = DroneVectorEnv(num_envs, **kwargs)
        super().__init__(num_envs, self._env.single_observation_space, self._env.single_action_space)
        self.render_mode = self._env.render_mode
        self._seed = seed

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Make the rows the parallel environments of this seed, from the next reset on."""
        self._seed = seed
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray[Any, Any]:
        chosen = [options.get("layout") for options in self._options]
        missing = sum(one is None for one in chosen)
        if 0 < missing < self.num_envs:
            raise ValueError(f"options layout={chosen}; give one for each environment, or none")
        options = None if missing else {"layout": chosen}
        observation, info = self._env.reset(seed=self._seed, options=options)
        self._seed = None
        self._reset_options()
        self.reset_infos = self._rows(info)
        return observation

    def step_async(self, actions: np.ndarray[Any, Any]) -> None:
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any], list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self._env.step(self._actions)
        infos = self._rows(info)
        done = terminated | truncated
        for row in np.flatnonzero(done):
            self.reset_infos[row] = infos[row]
            infos[row] = self._rows(info["final_info"], [row])[0]
            infos[row]["terminal_observation"] = info["final_obs"][row]
            infos[row]["TimeLimit.truncated"] = bool(truncated[row])
        return observation, reward.astype(np.float32), done, infos

    def _rows(self, info: dict[str, Any], rows: Any = ...) -> list[dict[str, Any]]:
        names = [name for name in info if not name.startswith("_") and not name.startswith("final")]
        columns = [info[name][rows].tolist() for name in names]
        return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]

    def get_images(self) -> Sequence[np.ndarray[Any, Any] | None]:
        return self._env.render() or [None] * self.num_envs

    def close(self) -> None:
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """A value for each index: of spaces and of what is around a drone its own row's, else the same."""
        value = getattr(self._env, f"single_{attr_name}", getattr(self._env, attr_name))
        return [value[row] if attr_name in AROUND else value for row in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self._env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method once, for all rows, which step together; indices: of all of them, or none.

        Raises:
            ValueError: the indices are of some rows only.
        """
        if len([*self._get_indices(indices)]) < self.num_envs:
            raise ValueError(f"indices={indices}; give none: the {self.num_envs} environments step together")
        return [getattr(self._env, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
