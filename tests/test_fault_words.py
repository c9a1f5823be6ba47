"""Faults as words and as rungs of a ladder, those that are refused, and what is truly there without them."""

import pytest
import torch

from uavnav import World
from uavnav.tasks.faults import NO_FAULTS, Faults, from_words
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.protocol import GROUPS
from uavnav.tasks.seeding import stream
from uavnav.tasks.table import TASKS, make_task
from uavnav.tasks.task import Task


def test_a_task_refuses_a_wrong_fault_a_wrong_stack_and_steps_without_draws():
    with pytest.raises(ValueError, match=r"there is no key 'faults.nois'; .*did you mean faults.noise"):
        make_task("test", faults={"nois": 5})
    for stack in (0, 1.5, 10**9):
        with pytest.raises(ValueError, match=f"stack={stack}; give a whole number from 1 to 1000"):
            make_task("test", stack=stack)
    task, at = make_task("test", faults={"noise": 5.0}), torch.tensor(0)
    with pytest.raises(ValueError, match="faults=noise=5: give draws"):
        task.start(at, torch.tensor(90))
    state = task.start(at, torch.tensor(90), task.draw(1, torch.Generator())[0])
    with pytest.raises(ValueError, match="faults=noise=5: give draws"):
        task.step(state, torch.tensor(9))


def test_words_of_a_command_become_faults_and_back():
    assert from_words("noise=5,late=2") == Faults(noise=5, late=2)
    assert from_words("none") == NO_FAULTS == Faults()
    assert str(Faults(lost=0.05, noise=5)) == "noise=5,lost=0.05"
    assert str(NO_FAULTS) == "none"
    for words, says in {
        "nois=5": "did you mean noise",
        "late=1.5": "late=1.5; give a number",
        "noise": "give a num",
    }.items():
        with pytest.raises(ValueError, match=says):
            from_words(words)


@pytest.mark.parametrize("name", GROUPS["faults"])
def test_each_rung_of_a_ladder_changes_one_fault_and_the_first_is_none(name):
    task = make_task("test", World(sensor_arc=90), stack=2)
    rungs = LADDERS[name].rungs
    climbed = [LADDERS[name].task(task, value, "test") for value in rungs]
    assert [getattr(one.faults, name) for one in climbed] == list(rungs)
    assert climbed[0].faults == NO_FAULTS
    assert {(type(one.task), one.world, one.stack) for one in climbed} == {(Task, task.world, 2)}
    both = LADDERS[name].task(LADDERS["noise"].task(task, 5, "test"), rungs[-1], "test")
    assert both.faults == Faults(noise=5).replace(**{name: rungs[-1]})


VELOCITIES = [(task, {"sense_velocity": True}) for task in ("moving", "space-moving")]


@pytest.mark.parametrize(
    ("task", "world"),
    [*VELOCITIES, *((task, fields) for task in TASKS for fields in ({}, {"padding": "zeros"}))],
)
def test_what_is_truly_there_and_then_disturbed_is_what_is_sensed(task, world):
    faulty = make_task("train", task=task, world=world, faults={"noise": 20.0, "lost": 0.3})
    layout = torch.arange(200)
    up = torch.full_like(layout, 90)
    place = faulty.task.start(layout, up)
    draws = faulty.draw(200, stream(0, "draws"))
    first, _ = faulty.sense(place)
    kept = faulty.start(layout.flip(0), up, draws, *first)
    for mine, wanted in zip(kept, faulty.start(layout.flip(0), up, draws), strict=True):
        assert torch.equal(mine, wanted)
    assert not torch.equal(kept.seen, faulty.remember(kept).seen)
