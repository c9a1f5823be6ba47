"""Compiled graphs; and where nothing can be compiled, one line that says so and why, or an error where it
was asked.
"""

import contextlib
import os
import subprocess
import sys

import pytest
import torch

from uavnav import graph
from uavnav.acting import ACTS, Actor
from uavnav.errors import ConfigError
from uavnav.graph import Graph
from uavnav.networks import mlp
from uavnav.tasks.seeding import stream

COMMAND = """
from uavnav.algorithms.ppo import PPOConfig, train
from uavnav.training import machine
machine.PAYS_FROM = 1
config = PPOConfig(
    n_envs=16, n_seeds={n_seeds}, total_frames=256, frames_per_batch=256, epochs=1, compile={compile!r})
print(train(config, {out!r}, quiet=True, processes={n_seeds}).meta["compiled"])
"""
NO_HEADER = """#!/bin/sh
case "$*" in *--version*) exec g++ "$@";; esac
echo "main.cpp:4:10: fatal error: Python.h: No such file or directory" >&2
exit 1
"""


def trained(tmp_path, compile, n_seeds=1, **environment):
    """A small run in a process, and its workers, whose tool chain is what the environment says; see
    `warm.run`.
    """
    command = COMMAND.format(compile=compile, n_seeds=n_seeds, out=str(tmp_path / "run"))
    env = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "graphs")} | environment
    return subprocess.run(
        [sys.executable, "-c", command], env=env, capture_output=True, text=True, check=False
    )


def warnings(result):
    return [
        line
        for line in result.stderr.splitlines()
        if "runs without compilation" in line and "warn(" not in line
    ]


@pytest.mark.usefixtures("warm")
def test_without_a_compiler_a_run_of_2_processes_goes_on_with_one_line_that_says_why(tmp_path):
    result = trained(tmp_path, "auto", n_seeds=2, CXX="/bin/false")
    assert result.stdout == "False\n"
    (line,) = warnings(result)
    assert "several times slower: InvalidCxxCompiler: No working C++ compiler found" in line


@pytest.mark.usefixtures("warm")
def test_without_a_compiler_compile_on_is_refused_in_one_line_before_anything_is_written(tmp_path):
    result = trained(tmp_path, "on", CXX="/bin/false")
    last = result.stderr.splitlines()[-1]
    assert (
        "ConfigError: compile=on: no graph can be compiled here (InvalidCxxCompiler: No working C++ compiler"
        in last
    )
    assert "install g++ and Python's headers" in last
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("cause", ["header", "cache"])
def test_a_missing_header_and_a_cache_that_cannot_be_written_are_named_and_the_run_goes_on(tmp_path, cause):
    compiler = tmp_path / "c++"
    compiler.write_text(NO_HEADER)
    compiler.chmod(0o755)
    environment, says = {
        "header": ({"CXX": str(compiler)}, "fatal error: Python.h: No such file or directory"),
        "cache": ({"TORCHINDUCTOR_CACHE_DIR": "/proc"}, "No such file or directory: '/proc/"),
    }[cause]
    result = trained(tmp_path, "auto", **environment)
    assert result.stdout == "False\n"
    (line,) = warnings(result)
    assert says in line


def counted(function):
    """A graph of a function, and how often its Python has run."""
    runs = []

    def traced(*tensors):
        runs.append(1)
        return function(*tensors)

    return Graph(traced), runs


def test_a_graph_is_traced_once_for_each_shape_type_and_stride_and_says_what_its_function_says(monkeypatch):
    """Its traces are run as they are: what inductor makes of one, other tests ask."""
    monkeypatch.setattr(graph, "standalone_compile", lambda traced, *given, **how: traced)
    of_sines, runs = counted(lambda x, y: (x.sin() + y, x.sum(-1)))
    rows = torch.arange(12.0).reshape(3, 4)
    given = [rows, rows.double(), rows[:2], rows.T, rows[:, ::2], rows[1:]]  # the last is as the third
    for _ in range(2):
        for x in given:
            y = torch.full_like(x, 0.5)
            for found, right in zip(of_sines(x, y), (x.sin() + y, x.sum(-1)), strict=True):
                torch.testing.assert_close(found, right)
                assert found.dtype == right.dtype
    assert len(runs) == 5


def test_a_graph_that_writes_into_what_it_is_given_does_so_once_a_call():
    adds, _ = counted(lambda total, x: (total.add_(x), x + 0)[1:])
    total = torch.zeros(3)
    for count in range(1, 4):
        adds(total, torch.ones(3))
        assert total.tolist() == [count] * 3


@pytest.mark.parametrize("acts", list(ACTS))
def test_compiled_policies_choose_by_the_weights_of_now(acts):
    network = mlp([30, 16, 100], "tanh", [stream(seed, "test") for seed in range(2)], "default")
    compiled, eager = (
        Actor(network, [0, 1], acts, "direct", compile, epsilon=lambda frames: 0.1)
        for compile in (True, False)
    )
    generator = torch.Generator().manual_seed(0)
    observation = torch.rand(2, 8, 30, generator=generator)
    chosen = []
    for _ in range(3):
        chosen.append(compiled.act(observation))
        assert torch.equal(chosen[-1], eager.act(observation))
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator))
    assert (chosen[0] != chosen[1]).float().mean() > 0.5


def test_a_function_that_asks_for_values_is_refused_and_not_frozen_at_its_first_ones():
    for function in (lambda x: (x + float(x.sum()),), lambda x: (x + torch.from_numpy(x.numpy()).max(),)):
        with pytest.raises(
            ConfigError, match=r"^no graph can be made \([^\n]+\); activations and rewards are only torch op"
        ):
            Graph(function)(torch.ones(3))


def descend(rate, weight, target, batch):
    """A step on the mean square of batch [A, N] times weight [A], against a target; its loss [1, A]."""
    weight = weight.detach().requires_grad_()
    with torch.enable_grad():
        loss = ((batch * weight[:, None] - target) ** 2).mean(1)
        (gradient,) = torch.autograd.grad(loss.sum(), [weight])
    return loss.detach()[None], weight.detach() - rate * gradient


@pytest.mark.compiled
def test_five_updates_as_a_graph_are_those_of_a_slow_loop():
    rates, target = torch.full((5,), 0.1), torch.tensor(0.5)
    batches = torch.rand(3, 5, 4, generator=torch.Generator().manual_seed(0))
    weight, expected, losses = torch.ones(3), torch.ones(3), []
    for index in range(5):
        loss, expected = descend(rates[index], expected, target, batches[:, index])
        losses.append(loss)
    (found,) = graph.Loop(descend, 1, 1)(rates, weight, target, batches)
    torch.testing.assert_close(weight, expected)
    torch.testing.assert_close(found, torch.stack(losses).mean(0))


TABLE = torch.tensor([2.0, 3.0, 5.0])


def wander(place, total, move, scale):
    """A place on a ring of three moves on; what it passes is summed up. Its outputs are an input twice."""
    there = (place + move) % 3
    return there, total + scale * TABLE[there], place, place, total * move


@pytest.mark.compiled
@pytest.mark.parametrize("missing", [None, "scan_op"])
def test_six_steps_as_a_graph_are_those_of_a_slow_loop_also_where_there_is_no_scan(missing, monkeypatch):
    if missing:
        monkeypatch.setattr(graph, missing, None)
    moves, scale = torch.tensor([[1, 2], [2, 2], [0, 1], [1, 1], [1, 0], [2, 1]]), torch.tensor(10.0)
    state, expected = (torch.tensor([0, 1]), torch.zeros(2)), []
    scan = graph.Scan(wander, 2, 1, time=1)
    with (
        contextlib.nullcontext() if missing is None else pytest.warns(UserWarning, match="one by one, slower")
    ):
        found = [scan(*state, moves, scale) for _ in range(2)][1]
    for move in moves:
        *state, first, second, third = wander(*state, move, scale)
        expected.append((first, second, third))
    assert all(torch.equal(one, other) for one, other in zip(found[:2], state, strict=True))
    for rows, column in zip(found[2:], zip(*expected, strict=True), strict=True):
        assert torch.equal(rows, torch.stack(column, 1))


def test_a_scans_step_is_traced_with_what_stands_for_tensors_so_that_it_may_take_another_way(monkeypatch):
    monkeypatch.setattr(graph, "_compiled", lambda function, *how: function)
    kinds = set()

    def step(state, given):
        kinds.update(map(type, (state, given)))
        return state + given, 2 * state

    after, doubled = graph.Scan(step, 1, 1)(torch.zeros(3), torch.ones(2, 3))
    assert after.tolist() == [2, 2, 2]
    assert doubled.tolist() == [[0, 0, 0], [2, 2, 2]]
    assert kinds
    assert torch.Tensor not in kinds


@pytest.mark.compiled
def test_a_step_that_asks_for_values_is_refused_by_a_scan_too():
    with pytest.raises(ConfigError, match="no graph can be made"):
        graph.Scan(lambda x, y: (x + float(y), x * y), 1, 1)(torch.ones(()), torch.ones(3))


@pytest.mark.compiled
def test_an_update_that_writes_into_one_of_two_equal_tensors_leaves_the_other_as_it_is():
    def update(rate, total, batch):
        one, other = torch.zeros(2), torch.zeros(2)
        one.add_(batch.sum(1))
        return other[None] + 3, total + one + other

    total = torch.zeros(2)
    (found,) = graph.Loop(update, 1, 0)(torch.ones(5), total, torch.ones(2, 5, 4))
    assert (total.tolist(), found.tolist()) == ([20, 20], [[3, 3]])


@pytest.mark.compiled
def test_a_callers_own_torch_compile_sees_its_own_settings_after_a_graph():
    settings = torch._inductor.config
    with settings.patch(compile_threads=2):
        before = settings.save_config_portable()
        Graph(lambda x: (x + 1,))(torch.ones(3))
        assert graph.problem("cpu") is None
        assert settings.save_config_portable() == before
        assert settings.compile_threads == 2
