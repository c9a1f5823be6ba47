"""Updates by themselves: optimisers, clipping, targets; test_algorithms compiles those of the table."""

import copy
import math
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import clip_grad_norm_

from uavnav import graph
from uavnav.training import update
from uavnav.training.update import ALIGNED, Adam, Learner, RMSprop, flattened, unflattened


class Losses(nn.Module):
    """What a loss module looks like to the learner, on one weight [A, 3]: two losses a row."""

    def __init__(self, agents):
        super().__init__()
        self.weight = nn.Parameter(torch.arange(1.0, 3 * agents + 1).reshape(agents, 3))
        self.register_buffer("scale", torch.tensor(2.0))

    def forward(self, batch):
        error = (batch["x"] * self.weight[:, None]).sum(-1) - batch["y"]
        return {"squared": self.scale * error.square(), "absolute": error.abs()}


def rows(*shape):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {"x": torch.rand(*shape, 3, generator=generator), "y": torch.rand(*shape, generator=generator)}, shape
    )


def learner(loss, max_grad_norm=1.0, compile=False, optimiser=Adam(0.1, 1e-5), tau=0.0):  # noqa: B008
    names = ["squared", "absolute"]
    return Learner(loss, names, optimiser, max_grad_norm=max_grad_norm, compile=compile, tau=tau)


@pytest.mark.parametrize("agents", [1, 3])
def test_flat_each_agent_has_a_row_each_tensor_begins_at_a_multiple_of_16_and_comes_back_as_a_view(agents):
    shapes = {"weight": (agents, 3, 7), "bias": (agents, 1, 16), "alpha": (agents,)}
    tensors = TensorDict({name: torch.rand(shape) for name, shape in shapes.items()}, [agents])
    flat = flattened([*tensors.values()])
    assert flat.shape == (agents, 32 + 16 + 16)
    back = unflattened(flat, tensors)
    assert (back == tensors).all()
    assert [*back.keys()] == [*shapes]
    for value in back.values():
        assert value.untyped_storage().data_ptr() == flat.data_ptr()
        assert value.storage_offset() % ALIGNED == 0
    last = unflattened(flat[-1:], tensors)  # as agents that learn in turn have it
    assert (last == tensors[-1:]).all()


def test_the_networks_read_what_the_learner_writes_weights_and_targets():
    mine = learner(Following(2), tau=0.2)
    mine.learn(rows(2, 5, 8))
    for name, flat in {"weight": "params", "target_weight": "targets"}.items():
        assert torch.equal(getattr(mine.loss, name), mine.flat[flat][:, :3])
    assert not torch.equal(mine.loss.weight, Following(2).weight)


OPTIMISERS = {
    "adam": (Adam(0.1, 1e-5), lambda parameters: torch.optim.Adam(parameters, lr=0.1, eps=1e-5)),
    "rmsprop": (
        RMSprop(0.1, 1e-5),
        lambda parameters: torch.optim.RMSprop(parameters, lr=0.1, alpha=0.99, eps=1e-5),
    ),
}


@pytest.mark.parametrize("kind", list(OPTIMISERS))
@pytest.mark.parametrize("max_grad_norm", [0.5, 100.0])
def test_twenty_updates_are_torchs_own_and_its_clipping_agent_by_agent(kind, max_grad_norm):
    ours, torchs = OPTIMISERS[kind]
    loss, batches = Losses(2), rows(2, 20, 8)
    mine = learner(copy.deepcopy(loss), max_grad_norm, optimiser=ours)
    found = mine.learn(batches)
    for agent in range(2):
        theirs = Losses(1)
        theirs.weight.data.copy_(loss.weight.data[agent : agent + 1])
        optimizer = torchs(theirs.parameters())
        norms = []
        for batch in batches[agent : agent + 1].unbind(1):
            optimizer.zero_grad()
            sum(part.mean() for part in theirs(batch).values()).backward()
            norms.append(clip_grad_norm_(theirs.parameters(), max_grad_norm))
            optimizer.step()
        torch.testing.assert_close(mine.loss.weight[agent], theirs.weight[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found["grad_norm"][agent], torch.stack(norms).mean(), rtol=1e-4, atol=1e-5)


def test_adams_rate_falls_linearly_from_all_of_it_and_would_be_0_after_the_last_step():
    steps = torch.arange(1, 21, dtype=torch.float64)
    falling, constant = (Adam(0.1, 1e-5, until=until).rates(steps) for until in (20, math.inf))
    torch.testing.assert_close(falling[:, 0] / constant[:, 0], 1 - torch.arange(20, dtype=torch.float64) / 20)
    assert torch.equal(falling[:, 1], constant[:, 1])


def test_losses_are_each_agents_means_over_its_rows_and_over_the_minibatches():
    loss, batches = Losses(2), rows(2, 3, 8)
    mine = learner(loss, optimiser=Adam(0.0, 1e-5))
    expected = {
        name: value.mean((1, 2))
        for name, value in loss(batches.flatten(1, 2)).items()
        for value in [value.reshape(2, 3, 8)]
    }
    found = mine.learn(batches)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value)


# -- targets -------------------------------------------------------------------------------------------------


class Following(Losses):
    """The same with a target of its weight, that its second loss is measured against."""

    def __init__(self, agents):
        super().__init__(agents)
        self.register_buffer("target_weight", torch.zeros(agents, 3))

    def forward(self, batch):
        found = super().forward(batch)
        away = (self.weight - self.target_weight).square().sum(-1)
        return found | {"absolute": found["absolute"] + away[:, None]}


class Two(Following):
    """And another weight, of another shape."""

    def __init__(self, agents):
        super().__init__(agents)
        self.shift = nn.Parameter(torch.arange(1.0, 2 * agents + 1).reshape(agents, 1, 2))

    def forward(self, batch):
        found = super().forward(batch)
        decay = sum(one.square().flatten(1).sum(1) for one in self.parameters() if one.requires_grad)
        return found | {
            "absolute": found["absolute"] * self.shift[..., 0] + self.shift[..., 1] + decay[:, None]
        }


@pytest.mark.parametrize(
    ("kind", "compile"),
    [("adam", False), ("rmsprop", False), pytest.param("adam", True, marks=pytest.mark.compiled)],
)
def test_a_step_for_the_whole_row_is_one_step_a_tensor_also_of_agents_in_turn_and_compiled(
    kind, compile, monkeypatch
):
    """In four calls, so that later ones begin with other weights and targets than a graph was traced with."""
    found, ways = [], [(few, large, compile) for few, large in ((2**16, 2**20), (0, 2**20), (0, 1))]
    for few, large, compiled in ((2**16, 2**20, False), *ways):
        monkeypatch.setattr(update, "FEW", few)
        monkeypatch.setattr(update, "LARGE", large)
        mine = learner(Two(2), optimiser=OPTIMISERS[kind][0], tau=0.2, compile=compiled)
        for batches in rows(2, 20, 8).split(5, 1):
            mine.learn(batches)
        found.append(mine.flat)
        assert mine.loss.scale == 2.0  # a buffer that is no target stays as it was
    for other in found[1:]:  # eager, the bits are the same
        torch.testing.assert_close(found[0], other, rtol=1e-5 * compile, atol=1e-6 * compile)
    assert not torch.equal(found[0]["params"], learner(Two(2)).flat["params"])


@pytest.mark.parametrize("kind", list(OPTIMISERS))
def test_a_saved_learner_goes_on_as_the_one_that_was_saved_its_targets_too(kind):
    one, other = (learner(Following(2), optimiser=OPTIMISERS[kind][0], tau=0.2) for _ in range(2))
    one.learn(rows(2, 5, 8))
    other.load_state_dict(one.state_dict())
    for each in (one, other):
        each.learn(rows(2, 3, 8))
    assert torch.equal(one.loss.weight, other.loss.weight)
    assert torch.equal(one.loss.target_weight, other.loss.target_weight)
    assert one.steps == other.steps == 8


def by_a_slow_loop(loss, batches, steps):
    """Torch's Adam agent by agent, and the target after each step."""
    optimisers = [torch.optim.Adam(one.parameters(), lr=0.1, eps=1e-5) for one in loss]
    for index in range(steps):
        for agent, (one, optimiser) in enumerate(zip(loss, optimisers, strict=True)):
            optimiser.zero_grad()
            sum(part.mean() for part in one(batches[agent : agent + 1, index]).values()).backward()
            clip_grad_norm_(one.parameters(), 1.0)
            optimiser.step()
            one.target_weight += 0.2 * (one.weight.detach() - one.target_weight)


def test_targets_that_move_softly_after_each_of_20_steps_are_those_of_a_slow_loop():
    """Compiled, they are those of eager steps."""
    batches, loss = rows(2, 20, 8), Following(2)
    alone = [Following(1), Following(1)]
    for agent, one in enumerate(alone):
        one.weight.data.copy_(loss.weight.data[agent : agent + 1])
    mine = learner(loss, tau=0.2)
    for some in batches.split(5, 1):
        mine.learn(some)
    by_a_slow_loop(alone, batches, 20)
    for agent, one in enumerate(alone):
        torch.testing.assert_close(loss.weight[agent], one.weight[0], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(loss.target_weight[agent], one.target_weight[0], rtol=1e-5, atol=1e-5)
        assert (one.target_weight[0] - one.weight[0]).abs().max() > 1e-2  # it follows, and is not there


def test_columns_in_another_order_as_a_refilled_buffer_has_them_are_one_graph(monkeypatch):
    traced, batch = [], rows(2, 1, 8)
    monkeypatch.setattr(
        graph, "standalone_compile", lambda one, *given, **how: traced.append(one.code) or one
    )
    for names in (("x", "y"), ("y", "x")):
        columns = TensorDict({name: batch[name] for name in names}, batch.shape)
        learner(Losses(2), compile=True).learn(columns)
    assert traced[0] == traced[1]


PAGES = """
import os, resource, torch
from uavnav.training import machine
def pages():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for sizes in ((0, 0), (6_400_000, 0), (0, 6_400_000), (0, 5_000_000)):
    if not os.fork():
        machine.keep_memory_flat(*sizes)
        for _ in range(2):
            before = pages()
            for _ in range(50):
                torch.ones(1_600_000)
        print(pages() - before, flush=True)
        os._exit(0)
    os.wait()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="pages are counted as Linux counts them")
def test_a_block_as_large_as_the_weights_stays_and_without_such_weights_goes_back():
    found = subprocess.run([sys.executable, "-c", PAGES], capture_output=True, text=True, check=True)
    without, with_layer, with_weights, with_fewer = map(int, found.stdout.split())
    assert min(without, with_fewer) >= 50 > max(with_layer, with_weights)
