"""Whole runs of DQN, watched: what they stored, drew and learned, against Gymnasium's worlds and plain
PyTorch.
"""

import copy
import itertools
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict

from uavnav.acting import Actor
from uavnav.algorithms.dqn import DQNConfig, make_network, train
from uavnav.algorithms.replay import make_replay
from uavnav.envs.gym import DroneVectorEnv
from uavnav.tasks.seeding import Streams
from uavnav.tasks.world import World
from uavnav.training.recorder import Recorder
from uavnav.training.update import Learner

UNLEARNED = {
    "n_seeds": 2,
    "n_envs": 16,
    "total_frames": 400,
    "learning_starts": 32,
    "lr": 0.0,
    "batch_size": 64,
}
"""25 steps of 16 environments, in which nothing is learned."""
SWITCHES = {"slots": "listed", "padding": "zeros"}
WATCHED = DQNConfig(
    seed=3,
    n_seeds=2,
    n_envs=16,
    total_frames=640,
    learning_starts=256,
    batch_size=8,
    target_update_frames=96,
    hidden=(32,),
    activation="relu",
    init="orthogonal",
    lr=5e-3,
    adam_eps=1e-3,
    gamma=0.5,
    loss="squared",
    max_grad_norm=1.0,
    epsilon_start=0.9,
    epsilon_end=0.2,
    exploration_fraction=0.75,
    max_steps=20,
    reward="initial",
    compile="off",
    world=SWITCHES,
)
"""40 steps of 16 environments, of which the last 24 are each followed by 4 updates, and no default that
matters.
"""


def watch(config, folder):
    """A run, its buffer, and what each step saw of it: epsilon, minibatches [A, N] and what they were
    learned with.
    """
    seen = SimpleNamespace(epsilons=[], minibatches=[], losses=[], learned=[])
    step, draw, checkpoint = Learner.step, Actor.draw, Recorder.checkpoint

    def watch_replay(config):
        seen.replay = make_replay(config)
        return seen.replay

    def watch_step(self, minibatch):
        seen.minibatches.append(self.read(minibatch, *self.memory))
        seen.losses.append(step(self, minibatch))
        return seen.losses[-1]

    def watch_draw(self, n_steps, n_envs):
        uniform, epsilon = draw(self, n_steps, n_envs)
        seen.epsilons += epsilon.tolist()
        return uniform, epsilon

    def watch_checkpoint(self, frames, parts, replay=None):
        seen.learned.append(len(seen.minibatches) - sum(seen.learned))
        checkpoint(self, frames, parts, replay)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavnav.algorithms.dqn.make_replay", watch_replay)
        patch.setattr("uavnav.algorithms.replay.LOG_FRAMES", 32)
        patch.setattr(Learner, "step", watch_step)
        patch.setattr(Actor, "draw", watch_draw)
        patch.setattr(Recorder, "checkpoint", watch_checkpoint)
        seen.run = train(config, out=folder, quiet=True)
    rows = seen.replay.buffer[:]
    observation, action, *flags, after = rows.split([30, 1, 1, 1, 1, rows.shape[-1] - 34], -1)
    following = {"reward": flags[0], "done": flags[1] > 0, "terminated": flags[2] > 0}
    following |= {"observation": after} if after.shape[-1] else {}
    parts = {"observation": observation, "action": action[..., 0].long(), "next": following}
    seen.stored = TensorDict(parts, rows.shape[:2])
    return seen


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    return watch(WATCHED, tmp_path_factory.mktemp("watched") / "run")


def test_each_step_of_16_worlds_after_frame_256_is_followed_by_4_updates_of_8_rows_an_agent(watched):
    assert watched.learned == [0] * 16 + [4] * 24
    assert all(batch.batch_size == (2, 8) for batch in watched.minibatches)


def test_each_4th_step_of_a_single_world_after_frame_10_is_followed_by_one_update(tmp_path):
    settings = {"n_envs": 1, "total_frames": 24, "learning_starts": 10, "batch_size": 8, "compile": "off"}
    seen = watch(DQNConfig(**settings), tmp_path / "run")
    assert [4 * turn for turn, learned in enumerate(seen.learned, start=1) if learned] == [12, 16, 20, 24]
    assert sum(seen.learned) == 4


def test_the_buffer_holds_the_640_transitions_that_gymnasiums_worlds_fly_with_the_same_actions(watched):
    """Where an episode ends, the next observation is its own last one, and only a collision is terminated."""
    stored = watched.stored
    assert stored.batch_size == (640, 2)
    ends = {"terminated": 0, "truncated": 0, "seen": 0}
    for agent, seed in enumerate(WATCHED.seeds):
        vector = DroneVectorEnv(16, world=World(**SWITCHES), max_steps=20, reward="initial")
        observation, _ = vector.reset(seed=seed)
        for row in stored[:, agent].split(16):
            np.testing.assert_array_equal(row["observation"], observation)
            observation, reward, terminated, truncated, info = vector.step(row["action"].numpy())
            following = observation.copy()
            for world in np.flatnonzero(terminated | truncated):
                following[world] = info["final_obs"][world]
                ends["seen"] += (following[world] != observation[world]).any()
            np.testing.assert_array_equal(row["next", "observation"], following)
            np.testing.assert_array_equal(row["next", "reward"].squeeze(-1), reward.astype(np.float32))
            np.testing.assert_array_equal(row["next", "terminated"].squeeze(-1), terminated)
            np.testing.assert_array_equal(row["next", "done"].squeeze(-1), terminated | truncated)
            ends["terminated"] += terminated.sum()
            ends["truncated"] += truncated.sum()
    assert min(ends.values()) >= 3


def whole(batch):
    """All of a transition in one vector."""
    following = [batch["next", name].float() for name in ("observation", "reward", "done", "terminated")]
    return torch.cat([batch["observation"], batch["action"][..., None].float(), *following], -1)


def test_each_agent_learns_from_4_draws_of_its_own_a_round_from_all_that_it_did_so_far(watched):
    for agent, seed in enumerate(WATCHED.seeds):
        stored = whole(watched.stored[:, agent])
        draws = Streams([seed], "replay")
        for index in range(24):
            used = whole(
                torch.cat([batch[agent] for batch in watched.minibatches[4 * index : 4 * index + 4]])
            )
            frames = 256 + 16 * (index + 1)
            assert torch.equal(used, stored[draws.draw(torch.randint, frames, (4 * 8,), device="cpu")[0]])


@pytest.mark.parametrize("agent", [0, 1])
def test_the_runs_96_updates_are_those_of_plain_pytorch_with_the_runs_own_numbers(watched, agent):
    """Every number that is not a default is written out here once more; the target is copied at 96, 192,
    ... 576.
    """
    network = make_network(DQNConfig(**vars(WATCHED) | {"n_seeds": 1, "seed": 3 + agent}))
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3, eps=1e-3)
    target, norms = copy.deepcopy(network), []
    minibatches = iter(batch[agent : agent + 1] for batch in watched.minibatches)
    for frames in range(16, 641, 16):
        if frames % 96 == 0:
            target = copy.deepcopy(network)
        for _ in range(4 if frames > 256 else 0):
            batch = next(minibatches)
            with torch.no_grad():
                following = target(batch["next", "observation"]).amax(-1, keepdim=True)
            worth = batch["next", "reward"] + 0.5 * following * ~batch["next", "terminated"]
            values = network(batch["observation"]).gather(-1, batch["action"][..., None])
            loss = (values - worth).square().mean()
            assert watched.losses[len(norms)]["loss"][agent].item() == pytest.approx(loss.item(), rel=1e-3)
            optimiser.zero_grad()
            loss.backward()
            norms.append(torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0).item())
            optimiser.step()
    assert len(norms) == 96
    assert min(norms) < 1.0 < max(norms)
    saved = load_file(watched.run.path / "policy.safetensors")
    for name, own in network.state_dict().items():
        torch.testing.assert_close(saved[f"policy.{name}"][agent : agent + 1], own, rtol=1e-4, atol=1e-4)


def test_every_step_explores_with_the_epsilon_of_the_frames_before_it(watched):
    assert watched.epsilons == pytest.approx(
        [WATCHED.epsilon(frames) for frames in range(0, 640, 16)], abs=1e-6
    )
    assert watched.epsilons[15:18] == pytest.approx(
        [1.0, 0.9 - 0.7 * 256 / 480, 0.9 - 0.7 * 272 / 480], abs=1e-6
    )
    assert watched.epsilons[-1] == pytest.approx(0.2, abs=1e-6)


def test_a_row_of_progress_every_32_frames_has_its_epsilon_and_the_means_of_its_4_updates(watched):
    progress = watched.run.progress
    assert progress.frame.tolist() == [frames for frames in range(32, 641, 32) for _ in (3, 4)]
    assert progress.seed.tolist() == [3, 4] * 20
    assert progress.epsilon.tolist() == pytest.approx(
        [WATCHED.epsilon(frames) for frames in progress.frame], abs=1e-6
    )
    for name in ("loss", "grad_norm"):
        assert progress[name][progress.frame <= 256].isna().all()
        by_round = torch.stack([losses[name] for losses in watched.losses]).reshape(24, 4, 2)
        assert by_round.std(1).min() > 0
        expected = by_round.mean(1)[1::2].flatten()  # frames 288, 320, ...: every other round
        np.testing.assert_allclose(progress[name][progress.frame > 256], expected, rtol=1e-5)


def test_the_runs_episodes_last_at_most_20_steps_and_earn_a_hundredth_of_their_distance(watched):
    terminated = watched.stored["next", "terminated"]
    episodes = watched.run.episodes
    assert episodes.steps.max() == 20
    assert (episodes.steps[episodes.truncated] == 20).all()
    assert episodes.truncated.sum() >= 20
    assert episodes.terminated.sum() == terminated.sum() >= 3
    earned = (0.01 * episodes.distance - episodes.reward).round(9)
    assert (earned[~episodes.terminated] == 0).all()
    # the step into the collision pays nothing else
    assert earned[episodes.terminated].between(10, 10.09).all()


def test_half_of_4000_actions_at_epsilon_one_half_are_explored_and_q_value_is_the_mean_of_the_best(tmp_path):
    config = DQNConfig(
        n_envs=16,
        total_frames=4_000,
        learning_starts=0,
        frames_per_update=800,
        lr=0.0,  # so that the greedy action of every step is known
        epsilon_start=0.5,
        epsilon_end=0.5,
        world={"start_heading": "random"},
        max_steps=100,
        compile="off",
    )
    seen = watch(config, tmp_path / "run")
    stored = seen.stored[:, 0]
    with torch.no_grad():
        values = make_network(config)(stored["observation"][None])[0]
    explored = stored["action"] != values.argmax(-1)
    assert explored.float().mean().item() == pytest.approx(0.5 * 0.99, abs=0.03)
    for digit in (stored["action"] // 10, stored["action"] % 10):  # of every turn and distance a tenth
        assert (torch.bincount(digit[explored], minlength=10) / explored.sum()).sub(0.1).abs().max() < 0.03
    best = values.amax(-1).reshape(250, 16).mean(1)
    progress = seen.run.progress
    np.testing.assert_allclose(progress.q_value, best[progress.frame.to_numpy() // 16 - 1], rtol=1e-4)
    assert progress.q_value.std() > 0


def test_runs_of_600_and_1000_frames_have_a_ring_of_1024_rows_and_so_one_graph():
    def rows(frames, **settings):
        return len(make_replay(DQNConfig(total_frames=frames, **settings)).storage.ring)

    assert [rows(frames) for frames in (600, 1_000, 1_024, 1_028)] == [1_024, 1_024, 1_024, 2_048]
    assert [rows(1_000, buffer_size=size) for size in (400, 1_000, 10**6)] == [400, 1_000, 1_024]


def test_a_buffer_of_48_keeps_the_newest_48_of_80_frames(tmp_path):
    settings = {"total_frames": 80, "learning_starts": 16, "batch_size": 4, "n_envs": 16, "max_steps": 1000}
    settings |= {"lr": 0.0, "compile": "off"}
    ring, everything = (
        watch(DQNConfig(buffer_size=size, **settings), tmp_path / str(size)).stored for size in (48, 80)
    )
    assert (ring.shape, everything.shape) == ((48, 1), (80, 1))
    newest = whole(everything)[32:]
    assert torch.equal(whole(ring), torch.cat([newest[16:], newest[:16]]))  # frames 48 to 79, then 32 to 47


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """Nothing is learned, under a time limit out of reach: next observations are kept."""
    config = DQNConfig(**UNLEARNED, max_steps=10_000, buffer_size=400, compile="off")
    return watch(config, tmp_path_factory.mktemp("full") / "run")


@pytest.mark.parametrize("size", [400, 88])
def test_a_buffer_without_next_observations_gives_the_transitions_that_one_with_them_holds(
    full, tmp_path, size
):
    """25 steps of 16 environments, nothing is learned: the two runs fly alike, one of them under a time limit
    out of reach.

    A buffer of 88 rows is full after five and a half steps, so that later ones lie across its end.
    """
    lean = watch(DQNConfig(**UNLEARNED, buffer_size=size, compile="off"), tmp_path / "lean")
    assert "observation" not in lean.stored["next"].keys()  # noqa: SIM118  (a TensorDict is not a dict)
    assert len(lean.minibatches) == len(full.minibatches) == 23 * 4
    for agent in (0, 1):
        everything = full.stored[:, agent].clone()
        collided = everything["next", "terminated"].squeeze(-1)
        everything["next", "observation"][collided] = (
            0.0  # worth nothing, and in the lean buffer another episode's
        )
        places = defaultdict(list)  # those of equal transitions are told apart by none
        for place, row in enumerate(whole(everything).tolist()):
            places[tuple(row)].append(place)
        assert collided.sum() > 5
        for index, batch in enumerate(lean.minibatches):
            drawn = batch[agent].clone()
            drawn["next", "observation"][drawn["next", "terminated"].squeeze(-1)] = 0.0
            frames = 16 * (3 + index // 4)
            known = range(max(0, frames - size), frames - 16)  # of the newest step no successor is known
            assert all(any(place in known for place in places[tuple(row)]) for row in whole(drawn).tolist())


@pytest.mark.parametrize("limit", [None, 7])
def test_targets_of_3_steps_sum_the_rewards_up_to_a_collision_or_limit_and_bootstrap_where_no_collision_was(
    tmp_path, limit
):
    """25 steps of 16 environments in which nothing is learned, and every world's episode once more by a slow
    loop.

    A time limit has an observation of its own, after as many steps as there were.
    """
    seen = watch(
        DQNConfig(**UNLEARNED, n_steps=3, gamma=0.5, max_steps=limit, compile="off"), tmp_path / "run"
    )
    stored = seen.stored
    assert len(seen.minibatches) == 22 * 4  # the first step after frame 48
    for agent in (0, 1):
        own = stored[:, agent].reshape(25, 16)  # step, world
        names = ("reward", "terminated", "done")
        reward, over, done = (own["next", name].squeeze(-1) for name in names)
        expected = {}
        for step, world in itertools.product(range(23 if limit else 22), range(16)):
            total, n, ended = 0.0, 0, False
            while n < 3 and not ended:
                total += 0.5**n * reward[step + n, world].item()
                collided, ended = over[step + n, world].item(), done[step + n, world].item()
                n += 1
            start = tuple(own["observation"][step, world].tolist()), own["action"][step, world].item()
            then = own["next", "observation"][step + n - 1] if limit else own["observation"][(step + 3) % 25]
            following = None if collided else (tuple(then[world].tolist()), n)
            expected.setdefault(start, []).append((total, collided, following))
        drawn = torch.cat([batch[agent] for batch in seen.minibatches])
        assert 100 < drawn["next", "terminated"].sum() < 5000
        if limit:
            early = (drawn["steps_to_next_obs"] < 3) & ~drawn["next", "terminated"]
            assert early.sum() > 500
        for row in drawn:
            worth = expected[tuple(row["observation"].tolist()), row["action"].item()]
            collided = row["next", "terminated"].item()
            n = row["steps_to_next_obs"].item() if limit else 3
            following = None if collided else (tuple(row["next", "observation"].tolist()), n)
            assert any(
                total == pytest.approx(row["next", "reward"].item(), abs=1e-5)
                and (ends, then) == (collided, following)
                for total, ends, then in worth
            )
