"""What every world of the table keeps, whatever it is: add one, and all of this asks it too."""

import json
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from safetensors import safe_open

import uavnav
from uavnav import evaluation, load_policy
from uavnav.algorithms import ppo
from uavnav.evaluation import verify
from uavnav.evaluation.summary import of_evaluation, of_run
from uavnav.runs import FILES
from uavnav.tasks import layouts
from uavnav.tasks.table import TASKS

FIELDS = {
    "moving": {"speed_max": 3.0, "sense_velocity": True},
    "space": {"depth": 700},
    "space-moving": {"depth": 700, "sense_velocity": True},
}
"""Of some worlds, others than the default."""

pytestmark = pytest.mark.parametrize("task", TASKS)


def test_a_run_of_two_seeds_stopped_and_resumed_ends_the_same_is_evaluated_and_verified(task, tmp_path):
    given = {
        "task": task,
        "world": FIELDS.get(task, {}),
        "layouts": "validation",
        "n_seeds": 2,
        "max_steps": 9,
    }
    config = ppo.PPOConfig(**given, total_frames=128, n_envs=2, frames_per_batch=64, hidden=(8,), epochs=1)
    with pytest.raises(uavnav.RunError):
        ppo.train(config, out=tmp_path / "run", quiet=True, until=64)
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    assert sorted(path.name for path in run.path.iterdir()) == sorted(FILES)
    with safe_open(run.path / "policy.safetensors", framework="pt") as file:
        header = json.loads(file.metadata()["uavnav"])
    assert (header["task"], header["world"]) == (task, vars(config.world))
    assert (
        header["layouts"]
        == run.meta["layouts"]["sha256"]
        == layouts.read("validation", config.world)[1]["sha256"]
    )
    found = load_policy(run.path).task
    assert (type(found.task), found.world) == (TASKS[task], config.world)
    rows = evaluation.evaluate_run(run, episodes=3, max_steps=40, quiet=True)
    assert len(rows) == 12
    titles = [column.header for table in (of_run(run), of_evaluation(rows, run)) for column in table.columns]
    assert task == "drone" or "paper" not in titles  # whose world is another
    assert verify.verify(run, quiet=True).same


@pytest.mark.parametrize("more", [{}, {"stack": 2, "faults": {"noise": 5.0}}])
def test_the_checkers_of_gymnasium_and_stable_baselines3_have_nothing_to_warn_about(task, more):
    env_checker = pytest.importorskip("stable_baselines3.common.env_checker")
    from uavnav.envs.sb3 import DroneVecEnv

    known = next(name for name, spec in gymnasium.registry.items() if spec.kwargs.get("task") == task)
    fields = FIELDS.get(task, {}) | more
    for check in (check_env, env_checker.check_env):
        with warnings.catch_warnings(action="error"):
            check(gymnasium.make(known, layouts="test", **fields).unwrapped)
    many = DroneVecEnv(2, layouts="test", task=task, **fields)
    size = many.observation_space.shape
    assert many.reset().shape == (2, *size)
    observation, reward, _, infos = many.step(np.array([3, 7]))
    assert (observation.shape, reward.shape, len(infos)) == ((2, *size), (2,), 2)
