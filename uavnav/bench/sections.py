"""The sections of the benchmarks in Markdown, and the table of targets."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import NamedTuple

from matplotlib.figure import Figure

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import growth, ours, parity, peers, plan
from uavnav.bench.plan import CORES, HELD_OUT, TARGET_REWARD, Measurement
from uavnav.bench.results import Result, Results, clock, median, number, ratio, table
from uavnav.bench.watch import WHOLE

# -- what must be reached ---------------------------------------------------------------------------------------------


class Target(NamedTuple):
    """A row of the table of targets."""

    label: str
    unit: str
    least: float
    aim: float | None
    value: float | None
    at_most: bool = False  # smaller is better

    @property
    def verdict(self) -> str:
        if self.value is None:
            return "not measured"
        for bound, word in ((self.aim, "aim reached"), (self.least, "reached")):
            if bound is not None and (self.value <= bound if self.at_most else self.value >= bound):
                return word
        return "**not reached**"

    @property
    def row(self) -> list[str]:
        return [self.label, self.unit, *map(number, (self.least, self.aim, self.value)), self.verdict]


def best_world(results: Results) -> list[float]:
    """Steps/s of the fastest way at its best batch size, one number a round."""
    names = results.measured("world")
    found = [results.sums(name, str(batch)) for name in names for batch in results.batches(name)]
    return max(found, key=statistics.median, default=[])


def peer(algorithm: str) -> str:
    """Whom it is compared with: plain PyTorch or SB3, in a table's words."""
    return "plain PyTorch" if algorithm in peers.PLAIN else "SB3"


def against_peer(results: Results, algorithm: str, key: str, n_seeds: int) -> float | None:
    """How many times less a whole run takes, per seed, than one of the peer alone on the machine."""
    who = "plain" if algorithm in peers.PLAIN else "sb3"
    theirs = results.values(f"training/{algorithm}/{who}/numpy", "whole")
    mine = results.values(f"training/{algorithm}/{key}", "whole")
    return ratio(theirs, [whole / n_seeds for whole in mine])


def targets(results: Results) -> list[Target]:
    """What must be reached, the aim, and what was measured."""
    world, numpy = best_world(results), results.values("gymnasium/numpy", "rate")
    millions = median([rate / 1e6 for rate in world])
    single = ratio(results.values("gymnasium/uavnav", "rate"), numpy)
    found = [
        Target("world, best batch size, two cores", "M steps/s", 0.9, 3, millions),
        Target("the same, against the NumPy world", "times", 80, None, ratio(world, numpy)),
        Target("Gymnasium single environment, against the NumPy world", "times", 1, 3, single),
    ]
    for algorithm, bounds in peers.SPEED_UPS.items():
        for n_seeds, (least, aim) in bounds.items():
            run = "one seed, 1 M frames" if n_seeds == 1 else f"{n_seeds} seeds, per seed"
            value = against_peer(results, algorithm, f"uavnav/{n_seeds}", n_seeds)
            found.append(
                Target(f"{algorithm.upper()} `paper`, {run}, against {peer(algorithm)}", "times", least, aim, value)
            )
    for algorithm in filter(ours.has_fast, ALGORITHMS):
        label = f"{algorithm.upper()} `fast`: first policy with a reward of {TARGET_REWARD}"
        found.append(Target(label, "s", 90, 20, fast_median(results, algorithm), at_most=True))
    for algorithm in filter(ours.has_buffer, ALGORITHMS):
        label = f"memory, {algorithm.upper()}, ten seeds of 1 M frames"
        found.append(Target(label, "GB", 4, 2, results.median(f"memory/{algorithm}", "peak"), at_most=True))
    return found


def write_targets(results: Results) -> list[str]:
    return [
        "Times and memory must be at most, all else at least, what the table says.",
        "",
        *table(["", "unit", "must", "aim", "measured", "verdict"], [one.row for one in targets(results)], left=2),
    ]


# -- the sections -----------------------------------------------------------------------------------------------------


def write_world(results: Results) -> list[str]:
    names, numpy = results.measured("world"), results.median("gymnasium/numpy", "rate")
    rows = []
    for batch in sorted({batch for name in names for batch in results.batches(name)}):
        steps = [median(results.sums(name, str(batch))) for name in names]
        best = max((value for value in steps if value), default=None)
        rows.append([f"{batch:,}", *map(number, steps), number(best / numpy if best and numpy else None)])
    head = ["batch size", *(name.split("/")[1] for name in names), "times NumPy"]
    return [
        "Steps/s of `DroneEnv` by batch size, with random actions, through the call that collectors make. Of processes"
        " side by side each has a batch of that size, and their steps are added. The last column is the best of the row"
        " against the NumPy world in one environment.",
        "",
        *table(head, rows),
    ]


def write_gymnasium(results: Results) -> list[str]:
    numpy = results.values("gymnasium/numpy", "rate")
    labels = {"numpy": "the NumPy world, `gymnasium.make`", "uavnav": '`gymnasium.make("uavnav/Drone-v0")`'}
    series = {label: results.values(f"gymnasium/{key}", "rate") for key, label in labels.items()}
    for batch in results.batches("gymnasium/vector"):
        series[f"`gymnasium.make_vec`, {batch} environments"] = results.values("gymnasium/vector", str(batch))
    rows = [
        [label, number(median(values)), number(ratio(values, numpy)), str(len(values))]
        for label, values in series.items()
        if values
    ]
    return [
        "Steps/s with random actions and resets, one thread. The NumPy world is `uavnav/bench/numpy_world.py`: one"
        " environment as one would write it for Stable-Baselines3. The same tests hold both worlds to one oracle.",
        "",
        *table(["", "steps/s", "times NumPy", "rounds"], rows),
    ]


class Trainer(NamedTuple):
    """Who trains."""

    label: str
    world: str
    n_seeds: int = 1
    threads: int = 1  # where a run does not say so itself


TRAINERS = {
    "uavnav/1": Trainer("uavnav, 1 seed", "batched"),
    "uavnav/10": Trainer("uavnav, 10 seeds", "batched", 10),
    "sb3/numpy": Trainer("SB3, alone", "NumPy"),
    "plain/numpy": Trainer("plain PyTorch, alone", "NumPy"),
    "sb3/two": Trainer("SB3, two processes side by side", "NumPy", 2),
    "sb3/uavnav": Trainer("SB3, alone", "our Gymnasium"),
    "sbx/numpy": Trainer("SBX (SB3 on JAX)", "NumPy", threads=CORES),
}


def write_training(results: Results) -> list[str]:
    lines = [
        f"Preset `paper`. A run is watched at work. A whole run of {WHOLE:,} frames is its start-up"
        " (imports, compilation from a warm cache) and its frames at the steady rate. Snapshots are left out: they take"
        " at most 4 % of a long run. Frames/s are of all seeds or processes together. DQN has a rate of its own before"
        " learning starts. SB3 and SBX learn with epsilon at 0.05, as in nine tenths of a whole run."
        " `times SB3` says how many times less a whole run takes, per seed, than one of SB3 alone on the NumPy world."
        " SB3 has no C51 and no discrete SAC: their peers are in `uavnav/bench/plain.py`, PyTorch after CleanRL's."
    ]
    for algorithm in ALGORITHMS:
        rows = [
            _training_row(results, algorithm, key)
            for key in TRAINERS
            if results.found.get(f"training/{algorithm}/{key}")
        ]
        before = ["frames/s before learning"] if ours.has_buffer(algorithm) else []
        head = [algorithm.upper(), "world", "threads", "rounds × frames", "start-up [s]", *before, "frames/s"]
        lines += ["", *table([*head, "1 M frames", "per seed", f"times {peer(algorithm)}", "peak [GB]"], rows, left=2)]
    return [
        *lines,
        "",
        "Peak memory is that of one run while it was watched, all its processes together; buffers of replay were not"
        " yet full. SBX does not clip DQN's gradient, and may use all cores. SB3 has one thread a process.",
    ]


def _training_row(results: Results, algorithm: str, key: str) -> list[str]:
    name, trainer = f"training/{algorithm}/{key}", TRAINERS[key]
    how = results.found[name][0][0]
    threads = str(how.get("threads") or trainer.threads)
    rates = [results.median(name, one) for one in ("rate_before", "rate")[not ours.has_buffer(algorithm) :]]
    whole = results.values(name, "whole")
    took = median(whole) or 0.0
    return [
        trainer.label,
        trainer.world,
        f"{how['processes']} × {threads}" if how.get("processes") else threads,
        f"{len(whole)} × {number(results.median(name, 'frames'))}",
        number(results.median(name, "startup")),
        *(number(rate and rate * trainer.n_seeds) for rate in rates),
        clock(took),
        clock(took / trainer.n_seeds),
        number(against_peer(results, algorithm, key, trainer.n_seeds)),
        number(results.median(name, "peak")),
    ]


def write_stages(results: Results) -> list[str]:
    stages = ["collection", "advantage", "buffer", "update", "logging", "other"]
    rows = []
    for name in results.measured("stages"):
        _, algorithm, who = name.split("/")
        shares = results.found[name][0][0]["shares"]
        label = {"sb3": "SB3", "1": "1 seed"}.get(who, f"{who} seeds")
        rows.append([f"{algorithm.upper()}, {label}", *(f"{100 * shares.get(stage, 0):.1f}" for stage in stages)])
    return [
        "Each stage's share of the time of steady work [%]; SB3 in the NumPy world.",
        "",
        *table(["", *stages], rows),
    ]


def write_compile(results: Results) -> list[str]:
    rows = []
    for algorithm in ALGORITHMS:
        times = [results.median(f"compile/{algorithm}/{kind}", "startup") for kind in ("off", "warm", "cold")]
        rates = [results.median(f"compile/{algorithm}/{kind}", "rate") for kind in ("off", "warm")]
        rows.append([algorithm.upper(), *map(number, [*times, *rates])])
    head = ["one seed", "eager [s]", "compiled, warm cache [s]", "cold cache [s]", "frames/s eager", "compiled"]
    return [
        "Start-up, from the command to steady work, and the rates without and with compilation.",
        "",
        *table(head, rows),
    ]


def write_memory(results: Results) -> list[str]:
    found = {name: results.found[name][0][0] for name in results.measured("memory")}
    return [
        f"{name.split('/')[1].upper()}, ten seeds, each buffer full with {number(one['frames'])} frames (filled in more"
        f" parallel worlds, to be quick), then a few updates: its processes held at most {one['peak']:.2f} GB together."
        for name, one in found.items()
    ]


FAST_COLUMNS = ("seed", "seconds", "frames")


def fast_rows(results: Results, algorithm: str) -> list[Result]:
    """What each seed found."""
    return [results.found[name][0][0] for name in results.measured(f"fast/{algorithm}")]


def fast_median(results: Results, algorithm: str) -> float | None:
    """Over seeds; a seed that did not get there took for ever."""
    return median([row["seconds"] or float("inf") for row in fast_rows(results, algorithm)])


def write_fast(results: Results) -> list[str]:
    lines = [
        "Seconds from the command, with warm caches, to the first policy whose mean reward is at least"
        f" {TARGET_REWARD} on {HELD_OUT} sets that were held out of training: sampled, at most 10,000 steps an episode."
        " A run's policies are judged about one second apart, each trained anew up to its frame; `-`: none reached it.",
    ]
    for algorithm in filter(ours.has_fast, ALGORITHMS):
        rows = [[number(row[key]) for key in FAST_COLUMNS] for row in fast_rows(results, algorithm)]
        lines += ["", f"{algorithm.upper()}, median {number(fast_median(results, algorithm))} s:", ""]
        lines += table(FAST_COLUMNS, rows)
    return lines


def write_worlds(results: Results) -> list[str]:
    batch, usual = str(plan.WORLD_BATCH), f"worlds/{plan.PAPER}"
    rows = []
    for name in results.measured("worlds"):
        rate, peak = results.median(name, batch), results.median(name, "peak")
        shares = [ratio(results.values(name, key), results.values(usual, key)) for key in (batch, "peak")]
        rows.append([name.split("/")[1], number(rate), number(shares[0]), number(peak), number(shares[1])])
    return [
        f"Steps/s of `DroneEnv`, compiled, {plan.WORLD_BATCH:,} rows in one process of one thread with random actions,"
        " and the peak memory of the process with its compiler. Each also as a share of the paper's world, `drone`: the"
        " median of the rounds' shares.",
        "",
        *table(["world", "steps/s", "times drone", "peak [GB]", "times drone"], rows),
    ]


# -- all of them ------------------------------------------------------------------------------------------------------


class Section(NamedTuple):
    """A section of the file."""

    title: str
    plan: Callable[[bool], list[Measurement]]
    write: Callable[[Results], list[str]]
    draw: Callable[[Results], Figure] | None = None
    kept: bool = False  # whether its rows are kept, so that it can be written again at any time


SECTIONS = {
    "world": Section("The world", plan.world, write_world),
    "gymnasium": Section("Gymnasium", plan.gymnasium, write_gymnasium),
    "training": Section("Training", plan.training, write_training),
    "stages": Section("Where the time goes", plan.stages, write_stages),
    "compile": Section("Compilation", plan.compilation, write_compile),
    "memory": Section("Memory", plan.memory, write_memory),
    "fast": Section("Preset `fast`", plan.fast, write_fast),
    "worlds": Section("More worlds", plan.worlds, write_worlds),
    "growth": Section("Growth", growth.plan, growth.section, growth.draw),
    "parity": Section(
        "Parity: is the learning the same?",
        lambda quick: parity.Store().plan(),
        lambda results: parity.section(parity.Store()),
        lambda results: parity.draw(parity.Store()),
        kept=True,
    ),
}
"""In the order of the file: those of `commands.benches.BY_DEFAULT`, then those of `LONGER`."""


def write(results: Results, names: list[str]) -> dict[str, list[str]]:
    """The lines of each section of which something was measured, or could not be."""
    found = {}
    for name in names:
        section = SECTIONS[name]
        lines = section.write(results) if results.measured(name) or section.kept else []
        missing = [f"- `{key}`: {why}" for key, why in results.missing.items() if key.startswith(f"{name}/")]
        if missing:
            lines += [*([""] if lines else []), "Not measured:", "", *missing]
        if lines:
            found[name] = lines
    if all(results.measured(name) for name in ("world", "gymnasium", "training")):
        found["targets"] = write_targets(results)
    return found
