"""Faults and stacks: a slow loop over whole episodes, closed forms, streams, and that nothing else
changes.
"""

import math

import oracle
import pytest
import torch
from slow_episodes import slow_episodes, take_over

from uavnav import DroneEnv
from uavnav.envs import scalar
from uavnav.tasks.baselines import reactive
from uavnav.tasks.faults import NAMES
from uavnav.tasks.seeding import stream
from uavnav.tasks.table import TASKS, make_task

ALL = {"noise": 5.0, "lost": 0.2, "late": 2, "sticky": 0.25}
SWITCHES = {
    "noise": {"faults": {"noise": 10.0}, "reward": "additive"},
    "lost": {"faults": {"lost": 0.3}, "world": {"padding": "zeros"}},
    "late": {"faults": {"late": 4}, "max_steps": 40},
    "sticky": {"faults": {"sticky": 0.5}, "world": {"start_heading": "random"}},
    "stack": {"stack": 4},
    "all": {"faults": ALL, "stack": 3, "world": {"slots": "listed"}, "max_steps": 30},
}


# -- a slow loop ---------------------------------------------------------------------------------------------


class SlowDrone:
    """One drone with faults, in float64 and plain Python: what it senses goes into a list, the newest
    last.
    """

    def __init__(self, episode, task, draws):
        self.episode, self.task = episode, task
        self.begin(draws)

    def begin(self, draws):
        self.seen, self.doubts, self.last = [], [], None
        self.sense(draws)

    def sense(self, draws):
        faults = self.task.faults

        def hear(nth, distance):
            lost = faults.lost and draws["lost"][nth] < faults.lost
            return None if lost else distance + (faults.noise * draws["noise"][nth] if faults.noise else 0)

        self.seen.append(sum(self.episode.sensed(hear), ()))
        self.doubts.append(self.episode.doubtful())

    def executed(self, action, draws):
        sticks = (
            self.last is not None and self.task.faults.sticky and draws["sticky"] < self.task.faults.sticky
        )
        self.last = self.last if sticks else action
        return self.last

    def remembered(self):
        newest = len(self.seen) - 1 - self.task.faults.late
        return [max(newest - back, 0) for back in range(self.task.stack)]

    def observation(self):
        return [number for nth in self.remembered() for number in self.seen[nth]]

    def doubtful(self):
        return any(self.doubts[nth] for nth in self.remembered())


def drawn(generator, faults, rows):
    """The numbers of one draw of a seed's stream, by row."""
    noise = torch.randn(rows, 10 if faults.noise else 0, generator=generator).tolist()
    n_lost = 10 if faults.lost else 0
    uniform = torch.rand(rows, n_lost + bool(faults.sticky), generator=generator).tolist()
    return [
        {"noise": normal, "lost": flat[:n_lost], "sticky": flat[-1] if faults.sticky else 1.0}
        for normal, flat in zip(noise, uniform, strict=True)
    ]


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("switch", SWITCHES)
def test_a_slow_loop_sees_and_earns_the_same_in_1056_poses_of_whole_episodes(switch, name):
    """Each of 6 switches in 5 worlds: 22 rows of 2 seeds for 48 steps; the draws come from the streams of
    each seed.
    """
    world = SWITCHES[switch].get("world", {}) | ({"sense_velocity": True} if "moving" in name else {})
    layouts = make_task("test", task=name).layouts[:40]
    env = DroneEnv([2, 11], layouts=layouts, seeds=[3, 8], task=name, **SWITCHES[switch] | {"world": world})
    task = env.task
    streams = {name: [stream(seed, name) for seed in (3, 8)] for name in ("first_faults", "faults")}

    def draw(name):
        return [one for generator in streams[name] for one in drawn(generator, task.faults, 11)]

    root, first = env.reset(), draw("first_faults")
    episodes = slow_episodes(
        task, *(part.flatten().tolist() for part in (env.state.layout, env.state.heading))
    )
    drones = [SlowDrone(episode, task, own) for episode, own in zip(episodes, first, strict=True)]
    generator, ended, doubtful = torch.Generator().manual_seed(1), 0, 0

    def compare(observation):
        sure = [row for row, drone in enumerate(drones) if not drone.doubtful()]
        expected = torch.tensor([drones[row].observation() for row in sure])
        torch.testing.assert_close(observation.flatten(0, 1)[sure], expected, rtol=0, atol=2e-4)
        return 22 - len(sure)

    for _ in range(48):
        actions = torch.randint(100, (2, 11), generator=generator)
        step, root = env.step_and_maybe_reset(root.set("action", actions))
        later, first = draw("faults"), draw("first_faults")
        after, now = (
            step["next"].flatten(),
            type(env.state)(*(part.flatten(0, 1).tolist() for part in env.state)),
        )
        for drone, action, own in zip(drones, actions.flatten().tolist(), later, strict=True):
            drone.episode.step(drone.executed(action, own))
            drone.sense(own)
        for name in ("steps", "stops", "turns", "distance"):
            assert after["episode", name].tolist() == [getattr(episode, name) for episode in episodes]
        for name in ("terminated", "truncated"):
            assert after[name].flatten().tolist() == [getattr(episode, name) for episode in episodes]
        assert after["reward"].flatten().tolist() == pytest.approx([one.reward for one in episodes], abs=2e-6)
        doubtful += compare(step["next", "observation"])
        for row, (episode, drone) in enumerate(zip(episodes, drones, strict=True)):
            if episode.terminated or episode.truncated:
                ended += 1
                episode.begin(episode.layout + 1, now.heading[row])
                drone.begin(first[row])
            else:
                take_over(episode, now, row)
        compare(root["observation"])
    assert ended >= 4
    assert doubtful < 50


# -- closed forms --------------------------------------------------------------------------------------------


def in_a_corner(n, heading=225, **how):
    """n rows at the same pose, where all ten slots are filled, and the draws of as many."""
    task = make_task("test", **how)
    state = task.task.start(torch.zeros(n, dtype=torch.int64), torch.full((n,), heading))
    state = state._replace(x=torch.full((n,), 80.0), y=torch.full((n,), 85.0))
    return task, state, task.draw(n, torch.Generator().manual_seed(0))


def test_of_100_000_echoes_a_share_of_p_is_lost_and_the_others_stay_where_they_are():
    task, state, draws = in_a_corner(10_000, faults={"lost": 0.2})
    true, clearance = task.task.observe(state)
    memory = task.remember(state, draws)
    sensed, same_clearance = memory.seen[:, 0], task.observe(memory)[1]
    true, sensed = true.unflatten(-1, (10, 3)), sensed.unflatten(-1, (10, 3))
    empty = (sensed == torch.tensor([0.0, 0.0, 1.0])).all(-1)
    assert not (true == torch.tensor([0.0, 0.0, 1.0])).all(-1).any()
    assert abs(empty.float().mean().item() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 100_000)
    assert (empty.float().mean(0) - 0.2).abs().max() < 5 * math.sqrt(0.2 * 0.8 / 10_000)
    assert torch.equal(sensed[~empty], true[~empty])
    assert torch.equal(clearance, same_clearance)


def test_the_noise_of_100_000_echoes_has_mean_0_and_the_standard_deviation_asked_for():
    task, state, draws = in_a_corner(10_000, faults={"noise": 2.0})
    true, sensed = (
        one.unflatten(-1, (10, 3))
        for one in (task.task.observe(state)[0], task.remember(state, draws).seen[:, 0])
    )
    assert torch.equal(true[..., :2], sensed[..., :2])
    error = (sensed - true)[..., 2] * 90  # [px], of slots that no clamp touches
    error = error[(true[..., 2] > 0.15) & (true[..., 2] < 0.85)]
    assert len(error) > 30_000
    assert abs(error.mean()) < 4 * 2 / math.sqrt(len(error))
    assert error.std().item() == pytest.approx(2, rel=4 / math.sqrt(2 * len(error)))


def test_a_slot_at_the_sensors_reach_is_clamped_after_the_noise_and_stays_in_view():
    task, state, _ = in_a_corner(2, faults={"noise": 20.0})
    shifts = torch.tensor([[100.0] * 10, [-100.0] * 10])
    sensed = task.remember(state, shifts).seen[:, 0].unflatten(-1, (10, 3))
    assert torch.equal(sensed[0, :, 2], torch.ones(10))
    assert torch.equal(sensed[1, :, 2], torch.zeros(10))
    assert torch.equal(sensed[..., :2], task.task.observe(state)[0].unflatten(-1, (10, 3))[..., :2])


def test_among_moving_obstacles_noise_leaves_velocities_and_a_lost_slot_has_none():
    task = make_task(
        "test", {"sense_velocity": True}, task="moving", stack=2, faults={"noise": 4.0, "lost": 0.3}
    )
    n = 400
    draws = [task.draw(n, torch.Generator().manual_seed(nth)) for nth in range(2)]
    state = task.start(torch.arange(n), torch.full((n,), 90), draws[0])
    state, outcome = task.step(state, torch.full((n,), 9), draws[1])
    true = task.task.observe(state)[0].unflatten(-1, (10, 5))
    seen = outcome.observation[:, :50].unflatten(-1, (10, 5))
    filled = true[..., 2] < 1
    lost = filled & (draws[1][:, 10:] < 0.3)
    kept = filled & ~lost
    assert lost.sum() > 50
    assert kept.sum() > 150
    assert torch.equal(seen[lost], torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0]).expand(int(lost.sum()), 5))
    others = [0, 1, 3, 4]
    assert torch.equal(seen[kept][:, others], true[kept][:, others])
    expected = (true[..., 2] + 4 / 90 * draws[1][:, :10]).clamp(0, 1)
    torch.testing.assert_close(seen[kept][:, 2], expected[kept], rtol=0, atol=1e-5)
    assert torch.equal(outcome.observation[:, 50:], state.seen[:, 1])  # of the start


def flown(task, actions, draws=None):
    """Observations of all steps of a batch, the first included: [T + 1, B, n]; actions [T, B], draws [T +
    1, B, n].
    """
    given = [None] * (len(actions) + 1) if draws is None else draws
    n = actions.shape[1]
    state = task.start(torch.arange(n), torch.full((n,), 90), given[0])
    seen = [task.observe(state)[0]]
    for action, own in zip(actions, given[1:], strict=True):
        state, outcome = task.step(state, action, own)
        assert torch.equal(outcome.observation, task.observe(state)[0])
        seen.append(outcome.observation)
    return torch.stack(seen)


@pytest.mark.parametrize("late", [1, 2, 4, 8])
@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_late_by_n_steps_shifts_observations_by_n_exactly_with_the_noise_they_were_sensed_with(late, noise):
    actions = torch.randint(100, (20, 6), generator=torch.Generator().manual_seed(0))
    prompt = make_task("test", faults={"noise": noise})
    draws = torch.randn(21, 6, prompt.n_draws, generator=torch.Generator().manual_seed(1))
    now = flown(prompt, actions, draws)
    then = flown(prompt.replace(faults=prompt.faults.replace(late=late)), actions, draws)
    assert torch.equal(then[late:], now[:-late])
    assert torch.equal(then[:late], now[:1].expand(late, -1, -1))
    assert not torch.equal(now[1:], now[:-1])


@pytest.mark.parametrize("late", [0, 3])
def test_a_stack_of_4_is_the_newest_4_observations_the_newest_first_and_begins_with_the_first_4_times(late):
    actions = torch.randint(100, (12, 5), generator=torch.Generator().manual_seed(0))
    single = make_task("test", faults={"late": late})
    one, four = flown(single, actions), flown(single.replace(stack=4), actions)
    assert four.shape == (13, 5, 120)
    for step in range(13):
        expected = torch.cat([one[max(step - back, 0)] for back in range(4)], -1)
        assert torch.equal(four[step], expected)


def test_of_40_000_steps_a_share_of_p_repeats_the_last_executed_action_and_never_the_first_step():
    task, n = make_task("test", faults={"sticky": 0.25}), 2_000
    generator = torch.Generator().manual_seed(0)
    state = task.start(torch.zeros(n, dtype=torch.int64), torch.full((n,), 90), task.draw(n, generator))
    repeated, last = 0, None
    for nth in range(21):
        given = torch.full((n,), nth)  # each step another one
        before = state
        state, outcome = task.step(state, given, task.draw(n, generator))
        if last is None:
            assert torch.equal(state.executed, given)
        else:
            stuck = state.executed != given
            assert torch.equal(state.executed[stuck], last[stuck])
            repeated += stuck.sum().item()
        turn, distance = zip(*map(oracle.decode, state.executed.tolist()), strict=True)
        assert torch.equal(state.distance - before.distance, torch.tensor(distance))
        assert torch.equal((state.heading - before.heading) % 360, torch.tensor(turn) % 360)
        earned = [
            oracle.reward(*one) for one in zip(turn, distance, outcome.terminated.tolist(), strict=True)
        ]
        torch.testing.assert_close(
            outcome.reward, torch.tensor(earned, dtype=torch.float64), rtol=0, atol=1e-12
        )
        last = state.executed
    assert abs(repeated / 40_000 - 0.25) < 4 * math.sqrt(0.25 * 0.75 / 40_000)


def test_faults_of_0_and_1_are_nothing_and_certain():
    actions = torch.randint(100, (9, 4), generator=torch.Generator().manual_seed(0))
    plain = flown(make_task("test"), actions)
    blind = make_task("test", faults={"lost": 1.0})
    draws = torch.stack([blind.draw(4, torch.Generator().manual_seed(nth)) for nth in range(10)])
    empty = torch.tensor([0.0, 0.0, 1.0]).repeat(10)
    assert torch.equal(flown(blind, actions, draws), empty.expand(10, 4, 30))
    stuck = make_task("test", faults={"sticky": 1.0})
    draws = torch.stack([stuck.draw(4, torch.Generator().manual_seed(nth)) for nth in range(10)])
    assert torch.equal(flown(stuck, actions, draws), flown(make_task("test"), actions[:1].expand(9, 4)))
    nothing = make_task("test", faults=dict.fromkeys(NAMES, 0))
    assert not nothing.remembers
    assert torch.equal(flown(nothing, actions), plain)


# -- rows, seeds, streams ------------------------------------------------------------------------------------


def test_another_seed_has_another_noise():
    here = {"layouts": torch.tensor([[[400.0, 420.0, 50.0]]]), "faults": {"noise": 5.0}}
    first = [DroneEnv([1], seeds=seed, **here).reset()["observation"] for seed in (0, 0, 1)]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])


# -- shells --------------------------------------------------------------------------------------------------


def test_the_scalar_core_hands_faults_and_stacks_to_a_batch_of_one():
    assert type(scalar.fly(make_task("test"))) is scalar.Episode
    for how in ({"stack": 2}, {"faults": {"sticky": 0.1}}, {"faults": {"late": 1}}):
        assert type(scalar.fly(make_task("test", **how))) is scalar.BatchOfOne


def test_stable_baselines3_sees_the_stack():
    sb3 = pytest.importorskip("uavnav.envs.sb3")
    env = sb3.DroneVecEnv(3, seed=0, layouts="test", stack=2, faults=ALL)
    assert env.reset().shape == (3, 60)
    observation, *_ = env.step(torch.tensor([9, 9, 9]).numpy())
    assert observation.shape == (3, 60)
    assert env.observation_space.shape == (60,)


def test_reactive_looks_at_the_newest_observation_of_a_stack():
    newest, older = torch.rand(2, 50, 30)
    assert torch.equal(reactive(torch.cat([newest, older], -1)), reactive(newest))
