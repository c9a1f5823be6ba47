"""Rounds of learning from replay as one graph: the same bits as one by one, and which of them are one."""

from types import SimpleNamespace

import pytest
import torch
from runs_by_hand import same
from tensordict import TensorDict

from uavnav.algorithms import ALGORITHMS, replay, rounds
from uavnav.algorithms.dqn import DQN, DQNConfig
from uavnav.algorithms.replay import Replay
from uavnav.algorithms.rounds import Rounds
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted

SMALL = {"n_seeds": 2, "compile": "on", "learning_starts": 64, "lr": 1e-2}
CASES = {
    # 4 steps and an update a round; the target is renewed in rounds 225 and 450; the ring has 300 rows
    "dqn": {
        "n_envs": 1,
        "total_frames": 2_500,
        "target_update_frames": 900,
        "buffer_size": 300,
        "hidden": (4,),
        "keep_at": (0.22, 0.58),  # between two rows, where blocks would lie
    },
    # a step and 2 updates a round; as in test_algorithms
    "sac": {
        "n_envs": 8,
        "total_frames": 640,
        "target_entropy": 0.3,
        "frames_per_update": 4,
        "activation": "crelu",
        "hidden": (16,),
    },
}


@pytest.mark.slow
@pytest.mark.compiled
@pytest.mark.parametrize("algorithm", CASES)
def test_25_rounds_as_one_graph_are_25_rounds_bit_for_bit_also_after_a_stop(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr(replay, "LOG_FRAMES", 400)
    config = ALGORITHMS[algorithm].config(**SMALL | CASES[algorithm])
    called, run = [], Rounds.run
    monkeypatch.setattr(Rounds, "run", lambda self, env: called.append(self) or run(self, env))
    one_by_one = train(config, tmp_path / "one", quiet=True, processes=1)
    assert not called  # a short run
    monkeypatch.setattr(rounds, "LEAST_ROUNDS", 0)
    together = train(config, tmp_path / "together", quiet=True, processes=1)
    assert len(called) * rounds.ROUNDS > 0.6 * config.updates / config.updates_per_step
    with pytest.raises(Interrupted):
        train(config, tmp_path / "stopped", quiet=True, processes=1, until=config.frames // 2)
    stopped = train(config, tmp_path / "stopped", quiet=True, processes=1)
    assert len({*called}) == 3  # also after the stop
    assert {len(one._graph._graphs) for one in called} == {1}  # compiled once
    kept_there = [*one_by_one.path.glob("policy-at-*")]  # which `same` does not know
    assert len(kept_there) == len(config.keep_at)
    for other in (together, stopped):
        for kept in kept_there:
            assert kept.read_bytes() == (other.path / kept.name).read_bytes()
            (other.path / kept.name).unlink()
        same(one_by_one.path, other.path)


@pytest.mark.slow
@pytest.mark.compiled
def test_where_no_such_graph_can_be_made_a_line_says_why_and_the_run_has_the_same_bits(tmp_path, monkeypatch):
    config = ALGORITHMS["sac"].config(**SMALL | CASES["sac"])
    one_by_one = train(config, tmp_path / "one", quiet=True, processes=1)
    monkeypatch.setattr(rounds, "LEAST_ROUNDS", 0)
    monkeypatch.setattr(Rounds, "_made", lambda self, *tensors: {}["a loop in a loop"])
    with pytest.warns(UserWarning, match="rounds run one by one, slower .*a loop in a loop"):
        same(one_by_one.path, train(config, tmp_path / "other", quiet=True, processes=1).path)


def test_an_algorithm_that_learns_otherwise_has_no_rounds_of_what_it_inherits_from():
    class Other(DQN):
        def learn(self, batch, frames):
            return None

    assert Other(DQNConfig(total_frames=1_000), compile=True).rounds is None


def test_no_round_of_a_graph_ends_with_a_row_a_renewed_target_or_a_policy_to_keep(monkeypatch):
    """With SB3's defaults a round is 4 frames, a row comes every 5,000 and a target every 10,000."""
    monkeypatch.setattr(Rounds, "_compile", lambda self, env: True)
    rounds_of = DQNConfig().make(compile=True).rounds
    env = SimpleNamespace(whole=lambda actor: True)
    found = {frames for frames in range(49_800, 70_000, 4) if rounds_of.ready(env, frames)}
    before = {end - n for end in (55_000, 60_000, 65_000, 70_000) for n in range(4, 104, 4)}
    apart = {*range(49_800, 50_000, 4)} | before
    assert found == {*range(49_800, 70_000, 4)} - apart
    kept = DQNConfig(keep_at=(0.0631,)).make(compile=True).rounds
    assert [kept.ready(env, frames) for frames in (62_996, 63_000, 63_096, 63_100)] == [1, 0, 0, 1]
    renewed = DQNConfig(target_update_frames=7_000).make(compile=True).rounds
    assert [renewed.ready(env, frames) for frames in (55_896, 55_900, 55_996, 56_000)] == [1, 0, 0, 1]
    assert [rounds_of.ready(env, frames) for frames in (999_800, 999_900, 999_904)] == [1, 0, 0]
    assert not rounds_of.ready(SimpleNamespace(whole=lambda actor: False), 50_000)


def test_a_short_run_an_eager_one_and_one_with_little_room_have_no_such_graph():
    env = SimpleNamespace(whole=lambda actor: True)
    for compile, how in ((True, {"total_frames": 100_000}), (True, {"buffer_size": 99}), (False, {})):
        assert not DQNConfig(**how).make(compile).rounds.ready(env, 50_000)


@pytest.mark.parametrize("capacity", [40, 64, 1_000])
@pytest.mark.parametrize(("keeps_next", "n_steps"), [(False, 1), (False, 3), (True, 1), (True, 2)])
def test_what_rounds_draw_before_their_rows_are_there_is_what_each_reads_of_the_ring(
    capacity, keeps_next, n_steps
):
    """Six rounds of 6 rows of 2 agents, in a ring that is full, gets full, or does not."""
    generator = torch.Generator().manual_seed(0)
    made = [Replay([3, 4], capacity, 2, 5, keeps_next, n_steps, 0.9) for _ in range(2)]

    def steps():
        """[A, W, T] of 2 agents in 2 environments."""
        numbers = {name: torch.rand(2, 2, 3, n, generator=generator) for name, n in (("s", 5), ("s'", 5))}
        flags = {name: torch.rand(2, 2, 3, 1, generator=generator) < 0.3 for name in ("done", "terminated")}
        following = {"observation": numbers["s'"], "reward": torch.rand(2, 2, 3, 1, generator=generator)}
        action = torch.randint(100, (2, 2, 3), generator=generator)
        return TensorDict(
            {"observation": numbers["s"], "action": action, "next": following | flags}, [2, 2, 3]
        )

    for _ in range(5):
        for one, batch in zip(made, [steps()] * 2, strict=True):
            one.extend(batch)
    slow, fast = made
    batches = [steps() for _ in range(6)]
    places, fresh = fast.draw_ahead(6, 6, n_batches=2, batch_size=7)
    before, rows = fast.storage.ring.clone(), torch.cat([fast.rows(batch) for batch in batches])
    assert (fresh >= 0).any()
    for number, batch in enumerate(batches):
        slow.extend(batch)
        expected = slow.read(slow.draw(2, 7), slow.storage.ring)
        known = torch.where(torch.arange(36)[:, None, None] < 6 * (number + 1), rows, torch.nan)
        drawn = TensorDict({"places": places[number], "fresh": fresh[number]}, [2, 2])
        found = fast.read(drawn, before, known)
        assert (found == expected).all()
    fast.write(rows)
    there = slice(len(slow.storage))
    assert torch.equal(fast.storage.ring[there], slow.storage.ring[there])
    assert fast.writer.state_dict() == slow.writer.state_dict()
    assert (slow.draw(1, 9) == fast.draw(1, 9)).all()
