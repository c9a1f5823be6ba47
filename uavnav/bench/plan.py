"""The table of jobs: every measurement, in the order of the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import Result
from uavnav.bench.jobs import Measurement
from uavnav.bench.training import SB3, SBX, WHOLE, settings
from uavnav.training import machine

CORES = min(2, machine.cores())
NUMPY = "gymnasium/numpy"
BATCHES = (1, 16, 256, 1024, 2048, 4096, 16_384, 32_768)
WORLD_BATCH = 4096
MANY = 16  # environments of a peer that has many
IN_SB3 = ("ppo", "dqn", "a2c")  # the algorithms that Stable-Baselines3 has too
FAULTS = {"noise": 5.0, "lost": 0.1, "late": 2, "sticky": 0.1}
TASKS: dict[str, Result] = {
    "drone": {},
    **{name: {"layouts": f"{name}/train"} for name in ("density-0", "density-20", "slalom-100")},
    "a sensor of 160 px": {"world": {"sensor_radius": 160.0}},
    "a sensor of 90 degrees": {"world": {"sensor_arc": 90.0}},
    "moving": {"task": "moving"},
    "moving, velocities sensed": {"task": "moving", "world": {"sense_velocity": True}},
    **{task: {"task": task} for task in ("goal", "space", "space-moving")},
    **{f"{name}={value}": {"faults": {name: value}} for name, value in FAULTS.items()},
}
"""Keywords of `DroneEnv` by name."""


def world() -> Iterator[Measurement]:
    """One process a core is the fastest way, and all that a quick run measures."""
    beside: Result = {"batches": BATCHES[2:6], "meeting": "", "copies": CORES}
    one = Measurement(
        f"world/compiled, {CORES} processes of 1 thread", "environments.batched", beside, base=NUMPY
    )
    yield replace(one, copies=CORES, quick={"batches": [WORLD_BATCH]})
    for kind, threads in dict.fromkeys((("compiled", CORES), ("compiled", 1), ("eager", 1))):
        how = {"batches": BATCHES, "compiled": kind == "compiled", "seconds": 0.7}
        yield replace(one, name=f"world/{kind}, threads: {threads}", arguments=how, threads=threads)


def gymnasium() -> Iterator[Measurement]:
    one = Measurement(NUMPY, "environments.single", {"which": "numpy"}, rounds=5, base=NUMPY)
    one = replace(one, quick={"seconds": 0.5})
    yield one
    yield replace(one, name="gymnasium/uavnav", arguments={"which": "uavnav"})
    for n in (16, 256):
        yield Measurement(
            f"gymnasium/uavnav, vector of {n}", "environments.vector", {"n_envs": n}, base=NUMPY
        )


def training(algorithm: str) -> Iterator[Measurement]:
    """Ours in one environment and in many, with one seed and with ten, and the peers that have the algorithm.

    What is compared is measured in turn ten times; other rows, fewer times.
    """
    many = f"in {settings(algorithm).n_envs} environments"
    name, quick, peers = f"training/{algorithm.upper()}", {"seconds": 5.0}, algorithm in IN_SB3
    run: Result = {"algorithm": algorithm, "seconds": 6.0}
    base, rounds = f"{name}, SB3" if peers else "", 10 if peers else 3
    mine = Measurement(
        "", "training.ours", run, CORES, 1, rounds, base=base, warm={"seconds": 0.0}, quick=quick
    )
    one = run | {"preset": "paper"}
    yield replace(mine, name=f"{name}, uavnav, 1 seed", arguments=one)
    yield replace(mine, name=f"{name}, uavnav, 1 seed {many}")
    yield replace(mine, name=f"{name}, uavnav, 10 seeds", arguments=one | {"n_seeds": 10})
    yield replace(mine, name=f"{name}, uavnav, 10 seeds {many}", arguments=run | {"n_seeds": 10})
    for which in ("collection", "updates"):
        apart = Measurement(f"{name}, its {which}", "training.part", one | {"which": which}, quick=quick)
        yield replace(apart, warm={"seconds": 0.0})
    run |= {"seconds": 10.0}
    peer = Measurement(base, "training.peer", run, rounds=2, base=base, needs=SB3)
    if peers:
        yield replace(peer, rounds=rounds, quick=quick)
        vector = run | {"n_envs": MANY}
        yield replace(peer, name=f"{base} in {MANY} environments", arguments=vector, rounds=rounds)
        yield replace(peer, name=f"{base}, two side by side", copies=2)
        yield replace(peer, name=f"{base}, our Gymnasium", arguments=run | {"which": "uavnav"})
    if algorithm in ("ppo", "dqn"):
        yield replace(peer, name=f"{name}, SBX", arguments=run | {"library": SBX}, threads=CORES, needs=SBX)


def memory() -> Iterator[Measurement]:
    """Ten seeds until their buffers are full, in many environments to be quick, and a few updates."""
    n_envs = WHOLE // 625
    run: Result = {"n_seeds": 10, "total_frames": WHOLE, "n_envs": n_envs}
    run |= {"frames_per_update": n_envs, "learning_starts": 4 * n_envs}
    for algorithm in (name for name in ALGORITHMS if hasattr(settings(name), "buffer_size")):
        arguments = run | {"algorithm": algorithm}
        yield Measurement(f"memory/{algorithm.upper()}", "training.whole", arguments, CORES, rounds=1)


def tasks() -> Iterator[Measurement]:
    for name, how in TASKS.items():
        arguments = {"batches": [WORLD_BATCH], "settings": how}
        yield Measurement(f"tasks/{name}", "environments.batched", arguments, rounds=5, base="tasks/drone")


def plan(sections: Sequence[str], quick: bool) -> list[Measurement]:
    """The measurements of sections; `quick`, shorter ones of one round each."""
    every = chain(world(), gymnasium(), *map(training, ALGORITHMS), memory(), tasks())
    found = [one for one in every if one.name.split("/")[0] in sections]
    if not quick:
        return found
    short = [(one, one.quick) for one in found if one.quick is not None]
    return [replace(one, arguments=one.arguments | changed, rounds=1) for one, changed in short]
