"""What is random in an episode: a row's numbers follow from its seed, whatever other rows do and whoever
steps.
"""

import gymnasium
import numpy as np
import pytest
import torch

import uavnav


@pytest.mark.parametrize(
    "how", [{"faults": {"noise": 5, "sticky": 0.2}}, {"world": {"start_heading": "random"}}]
)
def test_a_row_depends_on_its_seed_alone_in_300_steps_where_something_is_random(how):
    single = gymnasium.make("uavnav/Drone-v0", layouts="test", **how)
    one, three = (gymnasium.make_vec("uavnav/Drone-v0", n, layouts="test", **how) for n in (1, 3))
    env = uavnav.DroneEnv([3], layouts="test", seeds=[3, 8, 9], **how)
    seen = [single.reset(seed=3)[0], one.reset(seed=[3])[0][0], three.reset(seed=[3, 8, 9])[0][0]]
    there, ends = env.reset(), 0
    for actions in np.random.default_rng(1).choice([9, 49, 90], size=(300, 3)):
        np.testing.assert_array_equal(seen[1], seen[2])
        np.testing.assert_array_equal(seen[1], there["observation"][0].numpy())
        np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-5)
        _, there = env.step_and_maybe_reset(there.set("action", torch.tensor(actions)))
        observation, _, over, *_ = single.step(actions[0])
        ends += over
        seen = [
            single.reset()[0] if over else observation,
            one.step(actions[:1])[0][0],
            three.step(actions)[0][0],
        ]
    assert ends >= 5


@pytest.mark.parametrize("how", [{"faults": {"noise": 5}}, {"world": uavnav.World(start_heading="random")}])
def test_a_step_and_a_reset_apart_lead_to_the_same_200_observations_as_both_in_one_go(how):
    first, second = (uavnav.DroneEnv([2, 2], layouts="test", seeds=[0, 1], **how) for _ in range(2))
    there, here = first.reset(), second.reset()
    for actions in torch.as_tensor(np.random.default_rng(1).choice([9, 49], size=(200, 2, 2))):
        assert torch.equal(there["observation"], here["observation"])
        _, there = first.step_and_maybe_reset(there.set("action", actions))
        here = second.maybe_reset(second.step(here.set("action", actions))["next"])


@pytest.mark.parametrize("how", [{"faults": {"noise": 5}}, {"world": uavnav.World(start_heading="random")}])
def test_a_state_taken_between_a_step_and_its_reset_goes_on_to_the_same_starts(how):
    first, second = (uavnav.DroneEnv([1, 3], layouts="test", seeds=[seed], **how) for seed in (4, 5))
    there = first.reset()
    for _ in range(28):  # straight on: 28 steps lead to the wall, or to an obstacle before it
        there = first.step(there.set("action", torch.full((1, 3), 9)))["next"]
    second.load_state_dict(first.state_dict())
    over = there.clone().set("_reset", torch.ones(1, 3, 1, dtype=torch.bool))
    starts = [env.reset(over.clone())["observation"] for env in (first, second)]
    assert torch.equal(*starts)
    assert torch.equal(first.state.heading, second.state.heading)
