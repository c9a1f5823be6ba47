"""Random choices: the right distribution, and each agent's from its own stream."""

import pytest
import torch
from scipy import stats
from tensordict import TensorDict

from uavnav.acting import ACTS, HEADS, SHOWN, Actor, epsilon_greedy, sample_categorical, values_of
from uavnav.algorithms.replay import Replay
from uavnav.networks import mlp
from uavnav.tasks.seeding import Chance, Streams, places, stream
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World
from uavnav.training.machine import use_threads


def test_sampled_actions_follow_the_softmax_of_their_logits():
    logits = torch.tensor([0.0, 1.0, -2.0, 3.0, -60.0])
    uniform = torch.rand(200_000, generator=torch.Generator().manual_seed(0))
    actions = sample_categorical(logits.expand(200_000, 5), uniform)
    counts = torch.bincount(actions, minlength=5)
    assert counts[4] == 0
    expected = torch.softmax(logits.double(), 0)[:4]
    assert stats.chisquare(counts[:4].numpy(), (expected / expected.sum() * 200_000).numpy()).pvalue > 1e-3


def test_the_ends_of_the_unit_interval_give_the_first_and_the_last_action():
    logits = torch.zeros(2, 100)
    assert sample_categorical(logits, torch.tensor([0.0, 1 - 2**-24])).tolist() == [0, 99]


def test_epsilon_greedy_explores_uniformly_with_probability_epsilon():
    generator = torch.Generator().manual_seed(0)
    coin, choice = torch.rand(2, 100_000, generator=generator)
    values = torch.zeros(100_000, 100)
    values[:, 42] = 1
    actions = epsilon_greedy(values, 0.3, coin, choice)
    explored = actions[coin < 0.3]
    assert (actions[coin >= 0.3] == 42).all()
    assert abs(len(explored) / 100_000 - 0.3) < 0.006
    assert stats.chisquare(torch.bincount(explored, minlength=100).numpy()).pvalue > 1e-3


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_epsilon_of_0_never_explores_and_of_1_always_does(epsilon):
    coin, choice = torch.rand(2, 1000)
    actions = epsilon_greedy(torch.zeros(1000, 100), epsilon, coin, choice)
    assert torch.equal(actions, (choice * 100).long() if epsilon else torch.zeros(1000, dtype=torch.int64))


def actor(seeds, acts, head="direct", epsilon=0.0):
    """A network of each seed's own, and what it acts by."""
    network = mlp([30, 16, 100], "tanh", [stream(seed, "test network") for seed in seeds], "default")
    return Actor(network, seeds, acts, head, compile=False, epsilon=lambda frames: epsilon)


OBSERVATION = torch.rand(3, 40, 30, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("acts", "epsilon"), [("categorical", 0.0), ("epsilon-greedy", 0.4)])
def test_an_actor_of_3_agents_chooses_by_its_table_with_the_numbers_of_each_agents_own_stream(acts, epsilon):
    together = actor([7, 8, 9], acts, epsilon=epsilon)
    streams = [stream(seed, "actions") for seed in (7, 8, 9)]
    for _ in range(3):
        root = TensorDict({"observation": OBSERVATION}, [3, 40])
        assert together(root) is root
        for agent, generator in enumerate(streams):
            values = together.network(OBSERVATION)[agent]
            uniform = torch.rand(ACTS[acts].uniforms, 40, generator=generator)
            assert torch.equal(root["action"][agent], ACTS[acts].choose(values, epsilon, list(uniform)))


@pytest.mark.parametrize("acts", ACTS)
def test_an_actor_of_seed_8_acts_alone_as_among_3(acts):
    alone, among = (actor(seeds, acts, epsilon=0.5) for seeds in ([8], [7, 8, 9]))
    for _ in range(3):
        assert torch.equal(alone.act(OBSERVATION[1:2])[0], among.act(OBSERVATION)[1])


def test_an_actor_goes_on_from_its_streams_and_its_schedule():
    """40 worlds, and a share of random actions that falls by 0.1 a step: 1.0, 0.9, ..."""
    network = actor([1, 2, 3], "epsilon-greedy").network
    acts = {
        "acts": "epsilon-greedy",
        "head": "direct",
        "compile": False,
        "epsilon": lambda frames: 1 - frames / 400,
    }
    one, other = (Actor(network, [1, 2, 3], **acts) for _ in range(2))
    one.act(OBSERVATION)
    saved = one.state_dict()
    expected = [one.act(OBSERVATION) for _ in range(3)]
    assert one.draw(1, 40)[1].item() == pytest.approx(0.6)
    assert not torch.equal(other.act(OBSERVATION), expected[0])
    for again in (other, one):
        again.load_state_dict(saved)
        assert all(torch.equal(again.act(OBSERVATION), actions) for actions in expected)
        assert again.draw(2, 40)[1].tolist() == pytest.approx([0.6, 0.5])


def test_a_head_turns_3_outputs_an_action_into_the_one_that_counts(monkeypatch):
    monkeypatch.setitem(HEADS, "mean-of-three", lambda outputs: outputs.unflatten(-1, (-1, 3)).mean(-1))
    network = mlp([30, 16, 300], "tanh", [stream(0, "test network")], "default")
    greedy = Actor(network, [0], "epsilon-greedy", "mean-of-three", compile=False)
    outputs = network(OBSERVATION[:1])
    expected = (outputs[..., 0::3] + outputs[..., 1::3] + outputs[..., 2::3]).argmax(-1)
    assert torch.equal(greedy.act(OBSERVATION[:1]), expected)


def test_a_dueling_head_gives_the_actions_a_mean_of_v_and_keeps_the_differences_of_the_advantages():
    outputs = torch.randn(3, 5, 101, generator=torch.Generator().manual_seed(0))
    values = values_of("dueling", outputs)
    torch.testing.assert_close(values.mean(-1), outputs[..., 0])
    torch.testing.assert_close(values.diff(dim=-1), outputs[..., 1:].diff(dim=-1))


def test_a_distribution_is_read_as_its_mean_with_the_numbers_of_the_head():
    """Two actions, three atoms: 0, 2 and 4."""
    shares = torch.tensor([[0.2, 0.5, 0.3], [0.0, 0.0, 1.0]])
    values = values_of("distribution 0 4.0 3", shares.log().flatten()[None])
    assert values[0].tolist() == pytest.approx([0.5 * 2 + 0.3 * 4, 4])
    # v = 0, and a less its mean
    in_two = torch.cat([torch.zeros(3), shares.clamp(min=1e-30).log().flatten()])
    mean = shares.clamp(min=1e-30).log().mean(0)
    expected = ((shares.clamp(min=1e-30).log() - mean).softmax(-1) * torch.tensor([0.0, 2, 4])).sum(-1)
    torch.testing.assert_close(values_of("dueling-distribution 0 4.0 3", in_two), expected)


def test_learning_in_place_is_seen_by_the_actor_in_its_next_choice():
    greedy = actor([0], "epsilon-greedy")
    with torch.no_grad():
        greedy.network[-1].bias.zero_()[..., 77] = 1e6
    assert (greedy.act(OBSERVATION[:1]) == 77).all()


def test_a_picture_shows_probabilities_that_sum_to_1_and_q_values_as_they_are():
    values = OBSERVATION[0] * 10
    torch.testing.assert_close(SHOWN["probability"](values).sum(-1), torch.ones(40))
    assert torch.equal(SHOWN["Q value"](values), values)
    assert torch.equal(HEADS["direct"](values), values)


def ring(seeds, n_rows, capacity=10, **how):
    """A ring whose row r of agent a has the observation (r, seed of a); rows are written two at a time."""
    replay = Replay(seeds, capacity, 2, 2, keeps_next=not how, **how)
    for first in range(0, n_rows, 2):
        codes = torch.stack(
            torch.broadcast_tensors(
                *[torch.tensor(one) for one in ([[[first], [first + 1]]], [[[seed]] for seed in seeds])]
            ),
            -1,
        ).float()  # [A, W, T, 2]
        zero = torch.zeros(*codes.shape[:3], 1)
        following = {"observation": codes, **dict.fromkeys(("reward", "done", "terminated"), zero)}
        kind = {"observation": codes, "action": zero[..., 0], "next": following}
        replay.extend(TensorDict(kind, codes.shape[:3]))
    return replay


def drawn(replay, n):
    """What is drawn of a ring, as one minibatch: [A, n]."""
    return replay.read(replay.draw(1, n)[:, 0], replay.storage.ring)


def test_of_more_rows_than_a_ring_holds_the_newest_stay_whatever_the_number_of_threads():
    codes = torch.arange(300_000.0).reshape(1, 1, -1, 1)
    zero = torch.zeros_like(codes)
    following = dict.fromkeys(("reward", "done", "terminated"), zero)
    batch = TensorDict({"observation": codes, "action": zero[..., 0], "next": following}, codes.shape[:3])
    replay = Replay([0], 1_000, 1, 1, keeps_next=False)
    with use_threads(2):
        replay.extend(batch)
    assert torch.equal(replay.storage.ring[:, 0, 0].sort().values, codes[0, 0, -1_000:, 0])
    places = replay.writer.extend(torch.zeros(3_000, *replay.storage.ring.shape[1:]))
    assert len(places) == len(places.unique()) == 1_000  # else the threads race


def test_every_agent_gets_its_own_rows_and_the_same_ones_in_any_population():
    alone, among = ring([5], 10), ring([3, 5, 8], 10)
    for _ in range(3):
        a, b = drawn(alone, 64)["observation"], drawn(among, 64)["observation"]
        assert b.shape == (3, 64, 2)
        assert (b[..., 1] == torch.tensor([[3], [5], [8]])).all()
        assert torch.equal(a[0], b[1])
        assert not torch.equal(b[0, :, 0], b[1, :, 0])


def test_rows_come_with_their_successors_and_of_the_newest_2_none_is_drawn():
    """A ring of 10 rows, written in steps of 2 up to row 13: rows 4 to 11 are drawn alike, each before
    row + 2.
    """
    batch = drawn(ring([0, 1], 14, n_steps=1), 4000)
    rows, following = batch["observation"][..., 0], batch["next", "observation"][..., 0]
    assert torch.equal(following, rows + 2)
    counts = torch.bincount(rows.flatten().long(), minlength=12)
    assert counts[:4].sum() == 0
    assert stats.chisquare(counts[4:].numpy()).pvalue > 1e-3


def test_a_restored_sampler_draws_the_same_rows_again():
    replay = ring([1, 2], 10)
    state = replay.sampler.state_dict()
    first = replay.draw(2, 16)["places"]
    assert first.shape == (2, 2, 16, 1)
    replay.sampler.load_state_dict(state)
    assert torch.equal(first, replay.draw(2, 16)["places"])


def test_the_buffer_samples_as_torchrls_do():
    """Rows [1 + S, A, N, F] by its own call, of the ring that a graph reads."""
    replay = ring([1, 2], 14, n_steps=1)
    rows = replay.buffer.sample(32)
    assert rows.shape == (2, 2, 32, 2 + 4)
    assert torch.equal(rows[1, ..., 0], rows[0, ..., 0] + 2)
    assert (len(replay.buffer), replay.buffer.write_count) == (10, 14)


def test_streams_differ_by_seed_and_by_purpose():
    numbers = {
        (seed, purpose): torch.rand(4, generator=stream(seed, purpose)).tolist()
        for seed in (0, 1)
        for purpose in ("actions", "places")
    }
    assert len({tuple(values) for values in numbers.values()}) == 4
    assert numbers[0, "actions"] == torch.rand(4, generator=stream(0, "actions")).tolist()


def test_a_place_depends_on_its_seed_and_index_alone():
    few, many = places([3], 4, 10_000, "cpu"), places([1, 3, 2], 64, 10_000, "cpu")
    assert torch.equal(few[0], many[1, :4])
    assert places([3], 500, 7, "cpu").unique().tolist() == list(range(7))


def test_headings_are_whole_degrees_of_a_full_turn():
    drawn = Chance(make_task(world=World(start_heading="random")), [0], [20_000], "cpu").headings()
    assert drawn.min() == 0
    assert drawn.max() == 359
    assert drawn.dtype == torch.int64


def test_draws_are_stacked_by_agent():
    drawn = Streams([1, 2], "test").draw(torch.rand, 3, device="cpu")
    assert torch.equal(drawn[1], torch.rand(3, generator=stream(2, "test")))
