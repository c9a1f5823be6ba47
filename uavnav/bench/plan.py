"""What is measured: one function a section. `quick` shortens those that a quick run measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import ours, peers
from uavnav.bench.results import Result
from uavnav.bench.watch import WHOLE
from uavnav.training import machine

CORES = min(2, machine.cores())
PEERS = {"stable_baselines3": "Stable-Baselines3", "sbx": "SBX"}
"""Libraries that may not be installed."""
SB3 = "stable_baselines3"
BATCHES = [1, 16, 256, 1024, 4096, 16_384, 32_768]
TARGET_REWARD = 88.5
"""The paper's best: PPO with tanh."""
HELD_OUT = 200
"""The last sets of the train split, on which policies of the preset `fast` are judged instead of trained."""


@dataclass(frozen=True)
class Measurement:
    """One thing to measure: a job, and how it is run."""

    name: str  # section/...
    job: str  # module.function
    processes: Sequence[Result]  # the arguments of each process; all run side by side
    threads: int = 1  # of each process
    rounds: int = 3
    needs: str = ""  # a library that may not be installed
    cache: str = "graphs"  # the folder of compiled graphs
    cold: bool = False  # empty that folder first
    together: bool = False  # the processes measure in the same stretches of time
    warm: Result = field(default_factory=dict)  # changed arguments of a first round, only to warm the caches


def world(quick: bool) -> list[Measurement]:
    """First one process a core, which is the fastest way and all that `quick` measures; then threads, and eagerly."""
    beside = {"batches": [4096] if quick else [256, 512, 1024, 2048, 4096], "compiled": True, "seconds": 2.0}
    name = f"world/compiled, {CORES} processes of 1 thread"
    found = [Measurement(name, "worlds.batched", [beside] * CORES, together=True)]
    for kind in () if quick else ("compiled", "eager"):
        for threads in dict.fromkeys([CORES, 1]):
            arguments = {"batches": BATCHES, "compiled": kind == "compiled", "seconds": 0.7}
            name = f"world/{kind}, threads: {threads}"
            found.append(Measurement(name, "worlds.batched", [arguments], threads))
    return found


WORLD_BATCH = 4096
PAPER = "drone"
"""What the other worlds are measured against."""
WORLDS: dict[str, Result] = {
    PAPER: {},
    **{f"density-{k}": {"layouts": f"density-{k}/train"} for k in (0, 20)},
    "slalom-100": {"layouts": "slalom-100/train"},
    "a sensor of 160 px": {"world": {"sensor_radius": 160.0}},
    "a sensor of 90 degrees": {"world": {"sensor_arc": 90.0}},
    "moving": {"task": "moving"},
    "moving, velocities sensed": {"task": "moving", "world": {"sense_velocity": True}},
    "goal": {"task": "goal"},
    "space": {"task": "space"},
    "space-moving": {"task": "space-moving"},
    **{
        f"{fault}={value}": {"faults": {fault: value}}
        for fault, value in (("noise", 5.0), ("lost", 0.1), ("late", 2), ("sticky", 0.1))
    },
}
"""Keywords of `DroneEnv` by name."""


def worlds(quick: bool) -> list[Measurement]:
    """Every world, one process of one thread."""
    how: Result = {"batches": [WORLD_BATCH], "compiled": True, "seconds": 0.5 if quick else 2.0}
    return [
        Measurement(f"worlds/{name}", "worlds.batched", [how | {"settings": settings}], rounds=1 if quick else 5)
        for name, settings in WORLDS.items()
    ]


def gymnasium(quick: bool) -> list[Measurement]:
    seconds = 0.5 if quick else 2.0
    found = [
        Measurement(f"gymnasium/{which}", "worlds.single", [{"which": which, "seconds": seconds}], rounds=5)
        for which in ("numpy", "uavnav")
    ]
    vector = Measurement("gymnasium/vector", "worlds.vector", [{"batches": [16, 256], "seconds": seconds}])
    return found if quick else [*found, vector]


def training(quick: bool) -> list[Measurement]:
    """Ours and the peers; `quick`, ours and Stable-Baselines3 alone."""
    watched: Result = {"frames": 40_000, "seconds": 5.0} if quick else {"frames": 200_000, "seconds": 15.0}
    slow: Result = watched if quick else {"frames": 100_000, "seconds": 32.0}
    warm = {"seconds": 0.0} if quick else {}  # a single round must start as a user's second run does
    found = []
    for algorithm in ALGORITHMS:
        own = {"algorithm": algorithm, **watched}
        if quick and ours.has_buffer(algorithm):
            own["learning_starts"] = 12_000
        rows = [
            Measurement("uavnav/1", "ours.watched", [own], CORES, warm=warm),
            Measurement("uavnav/10", "ours.watched", [own | {"n_seeds": 10}], CORES, warm=warm),
        ]
        peer = {"algorithm": algorithm, **slow, "learning_starts": 2_000 if quick else 10_000}
        alone = peer | {"which": "numpy"}
        if algorithm in peers.PLAIN:
            rows.insert(0, Measurement("plain/numpy", "plain.watched", [alone]))
        elif algorithm in peers.SPEED_UPS:
            rows.insert(0, Measurement("sb3/numpy", "peers.watched", [alone], needs=SB3))
            rows += [
                Measurement("sb3/two", "peers.watched", [alone, alone], rounds=2, needs=SB3),
                Measurement("sb3/uavnav", "peers.watched", [peer | {"which": "uavnav"}], rounds=2, needs=SB3),
            ]
        if algorithm in peers.SBX:
            other = [alone | {"library": "sbx"}]
            rows.append(Measurement("sbx/numpy", "peers.watched", other, CORES, rounds=2, needs="sbx"))
        found += [replace(row, name=f"training/{algorithm}/{row.name}") for row in (rows[:3] if quick else rows)]
    return found


def stages(quick: bool) -> list[Measurement]:
    """One seed, five seeds as each of two processes has them of ten, and Stable-Baselines3."""
    found = []
    for algorithm in ALGORITHMS:
        run = _short(algorithm, 12.0) | {"stages": True}
        for n_seeds in (1, 5):
            name = f"stages/{algorithm}/{n_seeds}"
            found.append(Measurement(name, "ours.watched", [run | {"n_seeds": n_seeds}], rounds=1))
        if algorithm in peers.SPEED_UPS and algorithm not in peers.PLAIN:
            peer = {"algorithm": algorithm, "which": "numpy", "frames": 100_000, "seconds": 12.0}
            peer |= {"learning_starts": 2_000, "stages": True}
            found.append(Measurement(f"stages/{algorithm}/sb3", "peers.watched", [peer], rounds=1, needs=SB3))
    return found


def compilation(quick: bool) -> list[Measurement]:
    found = []
    for algorithm in ALGORITHMS:
        for kind in ("cold", "warm", "off"):
            run = _short(algorithm, 2.0) | {"compile": "off" if kind == "off" else "on"}
            one = Measurement(f"compile/{algorithm}/{kind}", "ours.watched", [run], threads=CORES, rounds=2)
            found.append(replace(one, cache=f"compile-{algorithm}", cold=kind == "cold"))
    return found


def _short(algorithm: str, seconds: float) -> Result:
    """A run of a whole run's settings that is watched for so long; a buffer is filled with as little as will do."""
    starts = {"learning_starts": 12_000} if ours.has_buffer(algorithm) else {}  # two rows of progress before
    return {"algorithm": algorithm, "frames": WHOLE, "seconds": seconds, **starts}


def memory(quick: bool) -> list[Measurement]:
    """Ten seeds until their buffers are full, in so many parallel worlds that it takes seconds, and a few updates."""
    n_worlds = WHOLE // 625
    run: Result = {"n_seeds": 10, "total_frames": WHOLE, "n_worlds": n_worlds, "frames_per_update": n_worlds}
    run |= {"learning_starts": 4 * n_worlds, "checkpoint_seconds": 5.0}
    return [
        Measurement(f"memory/{name}", "ours.whole", [run | {"algorithm": name}], CORES, rounds=1)
        for name in ALGORITHMS
        if ours.has_buffer(name)
    ]


def fast(quick: bool) -> list[Measurement]:
    """How soon the preset `fast` gives a good policy."""
    found = []
    for algorithm in filter(ours.has_fast, ALGORITHMS):
        for seed in range(5):
            run = {"algorithm": algorithm, "preset": "fast", "seed": seed, "patience": 240.0}
            run |= {"target": TARGET_REWARD, "held_out": HELD_OUT}
            one = Measurement(f"fast/{algorithm}/{seed}", "ours.reach", [run], CORES, rounds=1)
            found.append(replace(one, warm={} if seed else {"patience": 0.0}))
    return found
