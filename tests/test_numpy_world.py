"""The plain NumPy world is the world: equal to the oracle over whole episodes, as DroneGymEnv is in
test_gym.
"""

import warnings

import gymnasium
import numpy as np
import oracle
import pytest
from gymnasium.utils.env_checker import check_env

from uavnav.bench.numpy_world import NumpyDroneEnv, border_squares
from uavnav.envs.gym import DroneGymEnv
from uavnav.tasks import layouts
from uavnav.tasks.world import World


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test").tolist()


def wandering(steps, seed=0):
    """Random actions that mostly fly on, so that walls and circles are met."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(steps) < 0.5, rng.integers(5, 10, steps), rng.integers(100, size=steps))


def test_its_136_squares_are_the_oracles_in_the_same_order():
    assert border_squares(World()).tolist() == [list(corner) for corner in oracle.SQUARES]


def test_gymnasiums_checker_has_nothing_to_warn_about():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(NumpyDroneEnv(), skip_render_check=True)


def test_its_spaces_are_those_of_the_gymnasium_environment():
    mine, other = NumpyDroneEnv(), DroneGymEnv()
    assert mine.observation_space == other.observation_space
    assert mine.action_space == other.action_space


@pytest.mark.parametrize("max_steps", [None, 25])
def test_30_whole_episodes_equal_the_oracle(all_layouts, max_steps):
    env = NumpyDroneEnv("test", max_steps)
    observation, info = env.reset(seed=3)
    episode = oracle.Episode(all_layouts, info["layout"], max_steps=max_steps)
    actions, ended, doubts, steps = iter(wandering(10_000)), 0, 0, 0
    while ended < 30:
        assert (info["layout"], info["heading"]) == (episode.layout, episode.heading)
        assert (info["x"], info["y"]) == pytest.approx((episode.x, episode.y), abs=1e-9)
        assert info["clearance"] == pytest.approx(episode.clearance, abs=1e-9)
        if oracle.doubtful(episode.found):
            doubts += 1
        else:
            np.testing.assert_allclose(observation, sum(episode.slots, ()), rtol=0, atol=1e-6)
        action = int(next(actions))
        observation, reward, terminated, truncated, info = env.step(action)
        episode.step(action)
        steps += 1
        assert (terminated, truncated) == (episode.terminated, episode.truncated)
        assert reward == pytest.approx(episode.reward, abs=1e-12)
        if terminated or truncated:
            ended += 1
            episode.next_episode()
            observation, info = env.reset()
    assert steps > 500
    assert doubts < 0.03 * steps


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_a_seed_begins_at_the_place_where_droneenvs_gymnasium_form_begins(seed):
    mine, other = NumpyDroneEnv("test"), DroneGymEnv("test")
    assert mine.reset(seed=seed)[1] == pytest.approx(other.reset(seed=seed)[1], abs=1e-4)
    assert mine.reset()[1]["layout"] == other.reset()[1]["layout"]


def test_options_pick_layout_999_and_the_next_reset_takes_0():
    env = NumpyDroneEnv("test")
    assert env.reset(options={"layout": 999})[1]["layout"] == 999
    assert env.reset()[1]["layout"] == 0


def test_wrong_layouts_actions_limit_and_layout_files_are_refused_and_a_step_before_the_reset():
    env = NumpyDroneEnv("test")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    for layout in (-1, 1000, 2.5, "3", [1, 2]):
        with pytest.raises(ValueError, match="whole number from 0 to 999"):
            env.reset(options={"layout": layout})
    env.reset()
    for action in (-1, 100):
        with pytest.raises(ValueError, match="whole number from 0 to 99"):
            env.step(action)
    with pytest.raises(ValueError, match="max_steps=0"):
        NumpyDroneEnv(max_steps=0)
    with pytest.raises(layouts.LayoutError, match="choose from train, validation, test"):
        NumpyDroneEnv("trian")


def test_an_observation_is_not_changed_by_the_next_20_steps():
    env = NumpyDroneEnv("test")
    kept = env.reset(seed=0)[0]
    copy = kept.copy()
    for action in wandering(20):
        if env.step(action)[2]:
            env.reset()
    np.testing.assert_array_equal(kept, copy)
