"""What the benchmarks found, in Markdown: arithmetic, the table of targets, a section each, and the file."""

from __future__ import annotations

import datetime
import importlib.metadata
import math
import os
import platform
import re
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from uavnav.bench.jobs import WHOLE, Result
from uavnav.training import machine, recorder

CORES = min(2, machine.cores())
TARGET_REWARD = 88.5
"""The paper's best: PPO with tanh."""
FAST = f"PPO `fast`: first policy with a reward of {TARGET_REWARD}"
"""The row of the table of targets that has a flag of its own."""
VALIDATION = 200
"""Sets of the train split, its last ones, that are held out for judging the preset `fast`."""
MARK = re.compile(r"^<!-- bench: (\w+) -->\n", flags=re.MULTILINE)


class Results:
    """What was found: for each measurement its rounds, for each round its processes."""

    def __init__(self) -> None:
        self.found: dict[str, list[list[Result]]] = defaultdict(list)
        self.missing: dict[str, str] = {}

    def values(self, name: str, key: str) -> list[float]:
        """One number a round, the mean over its processes."""
        rounds = self.found.get(name, [])
        return [statistics.mean(one[key] for one in group) for group in rounds if all(key in one for one in group)]

    def sums(self, name: str, key: str) -> list[float]:
        """One number a round, the sum over its processes."""
        return [
            sum(one[key] for one in group) for group in self.found.get(name, []) if all(key in one for one in group)
        ]

    def median(self, name: str, key: str) -> float | None:
        values = self.values(name, key)
        return statistics.median(values) if values else None


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float | None:
    """The median of the rounds' ratios; where there are not as many of both, the ratio of the medians."""
    if not numerators or not denominators:
        return None
    if len(numerators) == len(denominators):
        return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))
    return statistics.median(numerators) / statistics.median(denominators)


def number(value: float | None) -> str:
    """Three digits that count, and thousands apart."""
    if value is None:
        return "-"
    if math.isinf(value):
        return "never"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def clock(seconds: float | None) -> str:
    """Hours, minutes and seconds."""
    return "-" if seconds is None else str(datetime.timedelta(seconds=round(seconds)))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """A Markdown table whose first columns, so many, stand to the left and the numbers to the right."""
    return [
        f"| {' | '.join(head)} |",
        f"|{'---|' * left}{'--:|' * (len(head) - left)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


# -- what must be reached ---------------------------------------------------------------------------------------------


class Target(NamedTuple):
    """A row of the table of targets."""

    label: str
    unit: str
    least: float
    aim: float | None
    value: Callable[[Results], float | None]
    at_most: bool = False  # smaller is better

    def verdict(self, value: float | None) -> str:
        if value is None:
            return "not measured"
        for bound, word in ((self.aim, "aim reached"), (self.least, "reached")):
            if bound is not None and (value <= bound if self.at_most else value >= bound):
                return word
        return "**not reached**"


def best_world(results: Results) -> list[float]:
    """Steps/s at the best batch size on all cores, one number a round."""
    best: tuple[float, list[float]] = (0.0, [])
    for name in (f"world/eager/{CORES}", f"world/compiled/{CORES}", f"world/compiled/{CORES} × 1"):
        for batch in {key for group in results.found.get(name, []) for one in group for key in one}:
            values = results.sums(name, batch)
            best = max(best, (statistics.median(values), values))
    return best[1]


def against_sb3(algorithm: str, n_seeds: int) -> Callable[[Results], float | None]:
    """How many times shorter a whole run is, per seed, than one of SB3 alone on the machine."""

    def value(results: Results) -> float | None:
        theirs = results.values(f"training/{algorithm}/sb3/numpy", "whole")
        mine = results.values(f"training/{algorithm}/uavnav/{n_seeds}", "whole")
        return ratio(theirs, [whole / n_seeds for whole in mine])

    return value


def memory(results: Results) -> float | None:
    """The peak of DQN with ten full buffers: of its process, or of all its processes where it has several."""
    found = [results.median("memory/10", key) for key in ("peak", "tree")]
    return max((value for value in found if value is not None), default=None)


def targets(store: Path) -> list[Target]:
    """What is to be reached: the least, the aim, and how each follows from what was measured."""

    def world(results: Results) -> float | None:
        return statistics.median(best_world(results)) if best_world(results) else None

    def world_ratio(results: Results) -> float | None:
        return ratio(best_world(results), results.values("gymnasium/numpy", "rate"))

    def gymnasium_ratio(results: Results) -> float | None:
        return ratio(results.values("gymnasium/uavnav", "rate"), results.values("gymnasium/numpy", "rate"))

    return [
        Target("world, best batch size, two cores", "M steps/s", 0.9e6, 3e6, world),
        Target("the same, against the NumPy world", "times", 80, None, world_ratio),
        Target("Gymnasium single environment, against the NumPy world", "times", 1, 3, gymnasium_ratio),
        Target("PPO `paper`, one seed, 1 M frames, against SB3", "times", 8, 20, against_sb3("ppo", 1)),
        Target("PPO `paper`, ten seeds, per seed, against SB3", "times", 25, 60, against_sb3("ppo", 10)),
        Target("DQN `paper`, one seed, 1 M frames, against SB3", "times", 6, 20, against_sb3("dqn", 1)),
        Target("DQN `paper`, ten seeds, per seed, against SB3", "times", 20, 60, against_sb3("dqn", 10)),
        Target(
            FAST,
            "s",
            90,
            20,
            lambda _: fast_median(store),
            True,
        ),
        Target("memory, DQN, ten seeds of 1 M frames", "GB", 4, 2, memory, True),
    ]


def write_targets(results: Results, store: Path) -> list[str]:
    return [
        "What must be reached (at most, for times and memory; at least, for all else), and what was measured.",
        "",
        *table(
            ["", "unit", "must", "aim", "measured", "verdict"],
            [_target_row(target, results) for target in targets(store)],
            left=2,
        ),
    ]


def _target_row(target: Target, results: Results) -> list[str]:
    value, scale = target.value(results), 1e6 if target.unit.startswith("M ") else 1
    shown = ["-" if one is None else number(one / scale) for one in (target.least, target.aim, value)]
    return [target.label, target.unit, *shown, target.verdict(value)]


def refresh_fast_target(path: Path, store: Path) -> None:
    """Put what is known of the preset `fast` into the table of targets of a file, where it has one."""
    (target,) = (one for one in targets(store) if one.label == FAST)
    row = f"| {' | '.join(_target_row(target, Results()))} |"
    if path.is_file():
        lines = path.read_text().splitlines(keepends=True)
        text = "".join(f"{row}\n" if line.startswith(f"| {FAST} |") else line for line in lines)
        save(path, lambda aside: aside.write_text(text))


# -- the sections -----------------------------------------------------------------------------------------------------


def write_world(results: Results) -> list[str]:
    columns = [one for one in results.found if one.startswith("world/")]
    batches = sorted({int(key) for name in columns for key in results.found[name][0][0]})
    processes = {name: name.split("/")[2].partition(" × ") for name in columns}
    numpy = results.median("gymnasium/numpy", "rate")
    rows = []
    for batch in batches:
        sums = [results.sums(name, str(batch)) for name in columns]
        medians = [statistics.median(values) if values else None for values in sums]
        best = max((value for value in medians if value is not None), default=None)
        times = number(best / numpy) if best and numpy else "-"
        rows.append([f"{batch:,}", *(number(value) for value in medians), times])
    head = [
        f"{name.split('/')[1]}, " + (f"{first} processes of 1 thread" if second else _threads(int(first)))
        for name, (first, _, second) in processes.items()
    ]
    return [
        "Steps/s of `DroneEnv` by batch size, with random actions, through the call that collectors make."
        " Processes side by side have a batch of that size each, and their steps are added. The last column is the best"
        " of the row against the NumPy world in one environment.",
        "",
        *table(["batch size", *head, "times NumPy"], rows),
    ]


def write_gymnasium(results: Results) -> list[str]:
    numpy = results.values("gymnasium/numpy", "rate")
    labels = {"numpy": "the NumPy world, `gymnasium.make`", "uavnav": '`gymnasium.make("uavnav/Drone-v0")`'}
    series = {label: results.values(f"gymnasium/{key}", "rate") for key, label in labels.items()}
    for batch in sorted({int(key) for group in results.found.get("gymnasium/vector", []) for key in group[0]}):
        series[f"`gymnasium.make_vec`, {batch} environments"] = results.values("gymnasium/vector", str(batch))
    rows = [
        [label, number(statistics.median(values)), number(ratio(values, numpy)), str(len(values))]
        for label, values in series.items()
        if values
    ]
    return [
        "Steps/s with random actions and resets, one thread. The NumPy world is `uavnav/bench/numpy_world.py`, one"
        " environment as one would write it for Stable-Baselines3; tests hold it to the same oracle.",
        "",
        *table(["", "steps/s", "times NumPy", "rounds"], rows),
    ]


WHO = {
    "uavnav/1": ("uavnav, 1 seed", "batched", 1),
    "uavnav/10": ("uavnav, 10 seeds", "batched", 10),
    "sb3/numpy": ("SB3, alone", "NumPy", 1),
    "sb3/two": ("SB3, two processes side by side", "NumPy", 2),
    "sb3/uavnav": ("SB3, alone", "our Gymnasium", 1),
    "cleanrl/numpy": ("plain PyTorch as CleanRL writes it", "NumPy", 1),
    "sbx/numpy": ("SBX (SB3 on JAX)", "NumPy", 1),
}
"""Who trains, in which world, and how many seeds at once."""


def write_training(results: Results) -> list[str]:
    lines = [
        f"Preset `paper`, tanh. A run is watched at work; a whole run of {WHOLE:,} frames is its start-up (imports,"
        " compilation from a warm cache) and its frames at the steady rate; snapshots, at most 4 % of a long run, are"
        " left out. Frames/s are of all seeds or processes together. DQN's rate before learning starts (50,000 frames)"
        " is apart; SB3 and its like learn with epsilon at 0.05, as in nine tenths of a whole run. `times SB3` says how"
        " many times shorter a whole run is, per seed, than one of SB3 alone on the NumPy world.",
    ]
    for algorithm in ("ppo", "dqn"):
        rows = []
        for key, (label, world, seeds) in WHO.items():
            name = f"training/{algorithm}/{key}"
            if not results.found.get(name):
                continue
            rates = [results.median(name, one) for one in ("rate_before", "rate")]
            whole = results.values(name, "whole")
            shorter = ratio(
                results.values(f"training/{algorithm}/sb3/numpy", "whole"), [value / seeds for value in whole]
            )
            how = results.found[name][0][0]
            threads = f"{how['threads']}" if how.get("threads") else str(CORES if key.startswith("sbx") else 1)
            threads = f"{how['processes']} × {threads}" if how.get("processes") else threads
            watched = results.median(name, "frames")
            rows.append(
                [
                    label,
                    world,
                    threads,
                    f"{len(whole)} × {number(watched)}",
                    number(results.median(name, "startup")),
                    *(number(None if rate is None else rate * seeds) for rate in rates[algorithm == "ppo" :]),
                    clock(statistics.median(whole)),
                    clock(statistics.median(whole) / seeds),
                    number(shorter),
                    number(results.median(name, "tree") or results.median(name, "peak")),
                ]
            )
        before = ["frames/s before learning"] if algorithm == "dqn" else []
        head = [algorithm.upper(), "world", "threads", "rounds × frames", "start-up [s]", *before, "frames/s"]
        lines += ["", *table([*head, "1 M frames", "per seed", "times SB3", "peak [GB]"], rows, left=2)]
    return [
        *lines,
        "",
        "Peak memory is that of one run while it was watched, all its processes together: DQN's buffers were not yet"
        " full. SBX does not clip"
        " DQN's gradient, and may use all cores; the other peers have one thread a process.",
    ]


def write_stages(results: Results) -> list[str]:
    names = [name for name, rounds in results.found.items() if name.startswith("stages/") and rounds]
    stages = ["collection", "advantage", "buffer", "update", "logging", "other"]
    rows = []
    for name in names:
        _, algorithm, who = name.split("/")
        shares = results.found[name][0][0]["shares"]
        label = {"sb3": "SB3", "1": "1 seed"}.get(who, f"{who} seeds")
        rows.append([f"{algorithm.upper()}, {label}", *(f"{100 * shares.get(stage, 0):.1f}" for stage in stages)])
    return [
        "Where the time of steady work goes [%]; SB3 in the NumPy world.",
        "",
        *table(["", *stages], rows),
    ]


def write_compile(results: Results) -> list[str]:
    rows = []
    for algorithm in ("ppo", "dqn"):
        times = [results.median(f"compile/{algorithm}/{kind}", "startup") for kind in ("off", "warm", "cold")]
        rates = [results.median(f"compile/{algorithm}/{kind}", "rate") for kind in ("off", "warm")]
        rows.append([algorithm.upper(), *map(number, [*times, *rates])])
    head = ["one seed", "eager [s]", "compiled, warm cache [s]", "cold cache [s]", "frames/s eager", "compiled"]
    return ["Start-up, from the command to steady work, and what it buys.", "", *table(head, rows)]


def write_memory(results: Results) -> list[str]:
    (found,) = results.found["memory/10"][0]
    return [
        f"DQN, ten seeds, each buffer full with {number(found['frames'])} frames (filled in more parallel worlds, to be"
        f" quick), then a few updates: the process held at most {found['peak']:.2f} GB, it and all processes that it"
        f" started {found['tree']:.2f} GB.",
    ]


def _threads(count: int) -> str:
    return "1 thread" if count == 1 else f"{count} threads"


WRITERS: dict[str, Callable[[Results], list[str]]] = {
    "world": write_world,
    "gymnasium": write_gymnasium,
    "training": write_training,
    "stages": write_stages,
    "compile": write_compile,
    "memory": write_memory,
}
TITLES = {
    "machine": "The machine",
    "targets": "What must be reached",
    "world": "The world",
    "gymnasium": "Gymnasium",
    "training": "Training",
    "stages": "Where the time goes",
    "compile": "Compilation",
    "memory": "Memory",
    "growth": "Growth",
    "fast": "Preset `fast`",
    "whole": "Whole runs",
    "parity": "Parity: is the learning the same?",
}
GATHERED = ("fast", "parity")
"""Sections of rows that are kept, each with the date and the commit of its own."""


def write_sections(results: Results, store: Path, only_measured: bool = False) -> dict[str, list[str]]:
    """What was measured, section by section; each with what of it could not be.

    only_measured: leave out the sections of which nothing was.
    """
    found = {}
    for name, writer in WRITERS.items():
        measured = any(key.startswith(f"{name}/") for key, rounds in results.found.items() if rounds)
        missing = [f"- `{key}`: {why}" for key, why in results.missing.items() if key.startswith(f"{name}/")]
        if measured or (missing and not only_measured):
            lines = writer(results) if measured else []
            found[name] = [
                *lines,
                *([""] if lines and missing else []),
                *(["Not measured:", "", *missing] if missing else []),
            ]
    if {"world", "gymnasium", "training"} <= set(found):
        found["targets"] = write_targets(results, store)
    return found


def write_fast(store: Path) -> list[str]:
    rows = [
        [str(int(row["seed"])), *map(_reached, (row["seconds"], row["frames"])), row["when"]]
        for row in fast_rows(store).to_dict("records")
    ]
    return [
        f"Seconds from the command (caches warm) to PPO's first policy whose mean reward is at least {TARGET_REWARD} on"
        f" {VALIDATION} sets that were held out of training, sampled, at most 10,000 steps an episode; policies are set"
        f" aside once a second and judged afterwards. Median: {number(fast_median(store))} s.",
        "",
        *table(["seed", "seconds", "frames", "measured"], rows),
    ]


def _reached(value: float) -> str:
    return "not reached" if math.isnan(value) else number(value)


def fast_rows(store: Path) -> pd.DataFrame:
    found = [pd.read_parquet(path) for path in sorted((store / "fast").glob("*.parquet"))]
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame({"seed": [], "seconds": []})


def fast_median(store: Path) -> float | None:
    """Over the seeds that were run; those that did not get there took for ever."""
    rows = fast_rows(store)
    return float(rows["seconds"].fillna(float("inf")).median()) if len(rows) else None


# -- the file ---------------------------------------------------------------------------------------------------------

HEADER = """# Benchmarks

Written by `python -m uavnav.bench`, on one machine, one measurement after the other, each in a fresh process. Figures
are medians over rounds; a ratio is the median of the rounds' ratios. Machines differ and drift, so read ratios."""


def when() -> str:
    """The date and the commit, in a few words."""
    commit = recorder._git_commit() or "unknown"
    return f"{datetime.datetime.now(datetime.UTC).date()}, commit {commit[:10]}{'+' * commit.endswith('+')}"


def of_machine() -> str:
    """It and the versions, in a sentence."""
    facts = recorder._facts()
    beside = {name: _version(name) for name in ("gymnasium", "stable-baselines3", "sbx-rl", "jax")}
    versions = facts["versions"] | {name: version for name, version in beside.items() if version}
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    processor = f"{facts['machine']['processor']}, {CORES} cores in use, {memory:.0f} GB, {platform.system()}"
    return f"{processor}; {', '.join(f'{name} {version}' for name, version in versions.items())}."


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def read_sections(path: Path) -> dict[str, str]:
    """The sections of a file that is there, as they stand."""
    if not path.is_file():
        return {}
    _, *parts = MARK.split(path.read_text())
    return dict(zip(parts[::2], (text.strip() for text in parts[1::2]), strict=True))


def write_file(path: Path, sections: dict[str, list[str]], seconds: float, mark: str = "") -> None:
    """Put sections into the file in place of the old ones; it is whole or as it was.

    seconds: that it took to measure them; mark: what to say beside the date.

    Raises:
        OSError: it cannot be written.
    """
    now, where = f"{when()}{mark and f', {mark}'}", of_machine()
    fresh = {}
    for name, lines in sections.items():
        note = now if name in WRITERS or name == "targets" else f"{now}, in {clock(seconds)}; {where}"
        note = f"Put together on {now}; {where}" if name in GATHERED else note
        fresh[name] = "\n".join([f"## {TITLES[name]}", "", f"*{note.removesuffix('.')}.*", "", *lines])
    if set(WRITERS) & set(sections):
        fresh["machine"] = "\n".join([f"## {TITLES['machine']}", "", f"{now}, in {clock(seconds)}; {where}"])
    every = read_sections(path) | fresh
    parts = [f"<!-- bench: {name} -->\n{every[name]}" for name in TITLES if name in every]
    save(path, lambda aside: aside.write_text("\n\n".join([HEADER, *parts]) + "\n"))


def save_figure(path: Path, figure: Figure) -> None:
    """Write a picture; it is whole or as it was."""
    save(path, lambda aside: figure.savefig(aside, format="png", dpi=110))


def save(path: Path, write: Callable[[Path], object]) -> None:
    """Write aside, then rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.aside")
    try:
        write(aside)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
