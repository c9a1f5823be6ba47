"""Benchmarks: the world, training and its peers, side by side on this machine, into one Markdown file.

`python -m uavnav.bench` measures everything in 40 minutes, `--quick` a first impression in 3. What takes longer has a
flag of its own (`--growth`, `--fast`, `--whole`, `--parity`) and a section of its own in the file, which later runs
keep. What a run that is stopped has found by then is written, and marked. Each measurement is a fresh process with a
fixed number of threads (`uavnav.bench.jobs`); measurements are interleaved over several rounds, and medians and ratios
of the same round are what is reported.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
from rich.console import Console

from uavnav.bench import growth, parity
from uavnav.bench.jobs import WHOLE, Job, JobError, Result
from uavnav.bench.report import (
    CORES,
    TARGET_REWARD,
    VALIDATION,
    WHO,
    WRITERS,
    Results,
    clock,
    fast_rows,
    number,
    refresh_fast_target,
    save_figure,
    table,
    when,
    write_fast,
    write_file,
    write_sections,
)
from uavnav.choices import Parser
from uavnav.runs import tables

MINUTES = {"full": 40.0, "quick": 2.8}
WARM_SECONDS = 60.0
"""For the compilation of an algorithm's graphs before a quick run, at most."""
BATCHES = [1, 16, 256, 1024, 4096, 16_384, 32_768]
SECTIONS = tuple(WRITERS)
"""What a plain run measures, and `--only` chooses from."""
PEERS = {"stable_baselines3": "Stable-Baselines3", "sbx": "SBX"}
OUT = Path("docs/benchmarks.md")
STOPS = (signal.SIGTERM, signal.SIGHUP)
INSTALL = "pip install -e '.[bench]'"


# -- the table of measurements ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measurement:
    """One thing to measure: a job of `jobs` and how it is run."""

    name: str  # section/...
    job: str
    arguments: Result
    threads: int = 1
    copies: int = 1  # processes side by side
    rounds: int = 3
    expected: float = 60.0  # [s] a round, to begin with
    needs: str = ""  # a module that may not be there
    cache: str = "graphs"  # which folder of compiled graphs
    cold: bool = False  # empty it first
    sample: bool = False  # note the memory of the tree of processes
    together: bool = False  # its processes measure in the same stretches of time

    @property
    def section(self) -> str:
        return self.name.split("/")[0]


def plan(quick: bool) -> list[Measurement]:
    """What a plain run measures, the most important first."""
    if not quick:
        return [*_plan_gymnasium(False), *_plan_training(False), *_plan_world(False), *_plan_rest(False)]
    every = [*_plan_world(True), *_plan_gymnasium(True), *_plan_training(True), *_plan_rest(True)]
    return [replace(one, rounds=1) for one in every]


def _plan_world(quick: bool) -> list[Measurement]:
    """On all cores first, as processes side by side, which is the fastest way; `quick`, no other."""
    beside = {"batches": [4096] if quick else [256, 512, 1024, 2048, 4096], "compiled": True, "seconds": 2.0}
    side_by_side = Measurement(
        f"world/compiled/{CORES} × 1", "world", beside, copies=CORES, expected=25 if quick else 60, together=True
    )
    if quick:
        return [side_by_side]
    return [
        side_by_side,
        *(
            Measurement(
                f"world/{'compiled' if compiled else 'eager'}/{threads}",
                "world",
                {"batches": BATCHES, "compiled": compiled, "seconds": 0.7},
                threads=threads,
                expected=60 if compiled else 12,
            )
            for compiled in (True, False)
            for threads in dict.fromkeys([CORES, 1])
        ),
    ]


def _plan_gymnasium(quick: bool) -> list[Measurement]:
    seconds = 0.5 if quick else 2.0
    vector = {"batches": [16, 256], "seconds": seconds}
    rows = [
        Measurement("gymnasium/numpy", "single", {"which": "numpy", "seconds": seconds}, rounds=5, expected=8),
        Measurement("gymnasium/uavnav", "single", {"which": "uavnav", "seconds": seconds}, rounds=5, expected=8),
        Measurement("gymnasium/vector", "vector", vector, expected=10),
    ]
    return rows[:2] if quick else rows


def _plan_training(quick: bool) -> list[Measurement]:
    """Both algorithms in turn; `quick`, ours and Stable-Baselines3 alone."""
    watched: Result = {"frames": 40_000, "seconds": 5.0} if quick else {"frames": 200_000, "seconds": 15.0}
    slow: Result = watched if quick else {"frames": 100_000, "seconds": 32.0, "least": 50_000}
    took = 10 if quick else 40
    found = {}
    for algorithm in ("ppo", "dqn"):
        own = {"algorithm": algorithm, **watched}
        peer = {"algorithm": algorithm, **slow, "learning_starts": 2_000 if quick else 10_000}
        if algorithm == "dqn" and quick:
            own |= {"learning_starts": 12_000}
        alone = peer | {"which": "numpy"}
        sb3 = Measurement("sb3/numpy", "sb3", alone, needs="stable_baselines3", expected=took)
        rows = [
            sb3,
            Measurement("uavnav/1", "ours", own, threads=CORES, expected=took),
            Measurement("uavnav/10", "ours", own | {"n_seeds": 10}, threads=CORES, expected=2 * took, sample=True),
            replace(sb3, name="sb3/two", copies=2, rounds=2),
            Measurement("cleanrl/numpy", "cleanrl", peer, rounds=2, expected=took),
            replace(sb3, name="sb3/uavnav", arguments=peer | {"which": "uavnav"}, rounds=2),
            replace(sb3, name="sbx/numpy", arguments=alone | {"library": "sbx"}, threads=CORES, rounds=2, needs="sbx"),
        ]
        found[algorithm] = [
            replace(row, name=f"training/{algorithm}/{row.name}") for row in (rows[:3] if quick else rows)
        ]
    return [row for both in zip(*found.values(), strict=True) for row in both]


def _plan_rest(quick: bool) -> list[Measurement]:
    seconds, starts = (3.0 if quick else 12.0), 12_000  # frames: two rows of progress before
    found = []
    for algorithm in ("ppo", "dqn"):
        learning = {"learning_starts": starts} if algorithm == "dqn" else {}
        run: Result = {"algorithm": algorithm, "frames": WHOLE, "seconds": seconds, **learning}
        for n_seeds in (1, 5):  # five of ten are what each of two processes has
            arguments = run | {"n_seeds": n_seeds, "stages": True}
            found.append(Measurement(f"stages/{algorithm}/{n_seeds}", "ours", arguments, rounds=1))
        peer: Result = {"which": "numpy", "frames": 100_000, "seconds": seconds, "learning_starts": 2_000}
        arguments = {"algorithm": algorithm, "stages": True, **peer}
        found.append(
            Measurement(f"stages/{algorithm}/sb3", "sb3", arguments, rounds=1, expected=25, needs="stable_baselines3")
        )
        short = run | {"seconds": 2.0}
        for kind in ("cold", "warm", "off"):
            arguments = short | {"compile": "off" if kind == "off" else "on"}
            name, cold = f"compile/{algorithm}/{kind}", kind == "cold"
            cache = f"compile-{algorithm}"
            found.append(
                Measurement(name, "ours", arguments, threads=CORES, rounds=2, expected=40, cache=cache, cold=cold)
            )
    full = {"n_seeds": 10, "frames": WHOLE}
    found.append(Measurement("memory/10", "buffer_memory", full, threads=CORES, rounds=1, sample=True))
    return sorted(found, key=lambda one: ["memory", "stages", "compile"].index(one.section))


# -- running it -------------------------------------------------------------------------------------------------------


class Runner:
    """Runs measurements one after the other.

    Args:
        store: the folder for graphs and rows.
        say: shows a line.
        minutes: no measurement is begun that would not end in this time.

    Once it was stopped by Ctrl-C, SIGTERM or SIGHUP, `stopped` is true and nothing more is measured.
    """

    def __init__(self, store: Path, say: Callable[[str], None], minutes: float = float("inf")) -> None:
        self.store, self.say = store, say
        self.stopped = False
        self.began = time.monotonic()
        self.end = self.began + 60 * minutes

    def run(self, measurements: Sequence[Measurement], warm: bool = False) -> Results:
        """All of them, round by round; what was found by then, if it is stopped.

        With `warm` the graphs of training runs are compiled before, so that a single round of each starts as a user's
        second run does.
        """
        results = Results()
        try:
            if warm:
                self._warm(measurements)
            self._run(measurements, results)
        except KeyboardInterrupt:
            self.stopped = True
            for one in measurements:
                if not results.found.get(one.name):
                    results.missing.setdefault(one.name, "the run was stopped before")
        return results

    def _run(self, measurements: Sequence[Measurement], results: Results) -> None:
        expected = {one.name: one.expected for one in measurements}
        rounds = [(turn, one) for turn in range(9) for one in measurements if turn < one.rounds]
        for count, (turn, one) in enumerate(rounds, 1):
            if one.needs and importlib.util.find_spec(one.needs) is None:
                if turn == 0:
                    results.missing[one.name] = f"{PEERS[one.needs]} is not installed: {INSTALL}"
                    self.say(f"{one.name}: {results.missing[one.name]}")
                continue
            left = self.end - time.monotonic()
            if expected[one.name] > left:
                results.missing.setdefault(one.name, "no time was left for it") if turn == 0 else None
                continue
            start = time.monotonic()
            try:
                found = self.measure(one, min(left + 5, 4 * 3600))
                results.found[one.name].append(found)
                said = _short(found)
            except JobError as error:
                results.missing[one.name] = said = f"failed: {error}"
            expected[one.name] = time.monotonic() - start
            self.say(f"{clock(time.monotonic() - self.began)} {count}/{len(rounds)} {one.name}: {said}")

    def _warm(self, measurements: Sequence[Measurement]) -> None:
        """Each share of agents that a process of theirs will have, until it learns; those of an algorithm together."""
        ours = [one for one in measurements if one.job == "ours" and one.section == "training"]
        for algorithm in dict.fromkeys(one.arguments["algorithm"] for one in ours):
            runs = [one.arguments for one in ours if one.arguments["algorithm"] == algorithm]
            in_one_process = {"seconds": 0.0, "stages": True}
            jobs = [("ours", run | in_one_process | {"n_seeds": n}) for run in runs for n in _shares(run)]
            try:
                self._side_by_side(jobs, 1, ours[0].cache, min(self.end - time.monotonic(), WARM_SECONDS))
            except JobError as error:
                self.say(f"{clock(time.monotonic() - self.began)} {algorithm}: not compiled before: {error}")
            else:
                self.say(f"{clock(time.monotonic() - self.began)} {algorithm}: compiled")

    def measure(self, one: Measurement, timeout: float) -> list[Result]:
        """One round: what each of its processes found."""
        if one.cold:
            shutil.rmtree(self.store / one.cache, ignore_errors=True)
        with tempfile.TemporaryDirectory() as meeting:
            arguments = one.arguments | ({"meeting": meeting, "copies": one.copies} if one.together else {})
            return self._side_by_side([(one.job, arguments)] * one.copies, one.threads, one.cache, timeout, one.sample)

    def _side_by_side(
        self, jobs: list[tuple[str, Result]], threads: int, cache: str, timeout: float, sample: bool = False
    ) -> list[Result]:
        """Start all at once, each of so many threads; what they found."""
        graphs = self.store / cache
        graphs.mkdir(parents=True, exist_ok=True)
        running: list[Job] = []
        try:
            running.extend(Job(name, arguments, threads, graphs) for name, arguments in jobs)
            return [job.result(timeout, sample) for job in running]
        finally:
            for job in running:
                job.stop()


def _shares(run: Result) -> list[int]:
    """How many agents the processes of a run have."""
    n = run.get("n_seeds", 1)
    return sorted({n // CORES, -(-n // CORES)} - {0})


def _short(found: list[Result]) -> str:
    """What a measurement found, in a few words."""
    pairs = [(key, value) for key, value in found[0].items() if type(value) in (int, float)]
    return ", ".join(f"{key} {number(value)}" for key, value in pairs)


# -- what has a flag of its own ---------------------------------------------------------------------------------------


def measure_growth(runner: Runner, out: Path) -> dict[str, list[str]]:
    """Time and memory against seeds, worlds and hidden width."""
    points = growth.points()
    measurements = [
        Measurement(point.name, "ours", point.arguments, threads=CORES, rounds=1, sample=True) for point in points
    ]
    results = runner.run(measurements)
    rows = {point: results.found[point.name][0][0] for point in points if results.found.get(point.name)}
    if not rows:
        return {}
    picture = out.with_suffix(".png")
    save_figure(picture, growth.draw(rows))
    return {"growth": growth.section(rows, picture.name)}


def measure_whole(runner: Runner, out: Path) -> dict[str, list[str]]:
    """Whole runs of 1 M frames, to their end, SB3's two algorithms and ours."""
    peer: Result = {"which": "numpy", "frames": WHOLE, "seconds": 1e9, "learning_starts": 50_000, "whole": True}
    measurements, rows = [], []
    for algorithm in ("ppo", "dqn"):
        own: Result = {"algorithm": algorithm}
        measurements += [
            Measurement(f"{algorithm}/uavnav/1", "ours_whole", own, threads=CORES, rounds=1, sample=True),
            Measurement(
                f"{algorithm}/uavnav/10", "ours_whole", own | {"n_seeds": 10}, threads=CORES, rounds=1, sample=True
            ),
            Measurement(f"{algorithm}/sb3/numpy", "sb3", own | peer, rounds=1, needs="stable_baselines3"),
        ]
    results = runner.run(measurements)
    if not any(results.found.values()):
        return {}
    for one in measurements:
        algorithm, key = one.name.split("/", 1)
        whole, sb3 = results.median(one.name, "whole"), results.median(f"{algorithm}/sb3/numpy", "whole")
        shorter = number(WHO[key][2] * sb3 / whole) if whole and sb3 else "-"
        peak = number(results.median(one.name, "tree") or results.median(one.name, "peak"))
        rows.append([f"{algorithm.upper()}, {WHO[key][0]}", clock(whole), shorter, peak])
    head = ["", "from the command to the end", "times SB3, per seed", "peak [GB]"]
    return {"whole": [f"Whole runs of {WHOLE:,} frames a seed, snapshots included, one each.", "", *table(head, rows)]}


def measure_fast(runner: Runner, out: Path) -> dict[str, list[str]]:
    """How soon the preset `fast` of PPO gives a good policy: five seeds, each kept once it was run."""
    arguments = {"preset": "fast", "target": TARGET_REWARD, "held_out": VALIDATION, "patience": 240.0}
    paths = {seed: runner.store / "fast" / f"{seed}.parquet" for seed in range(5)}
    missing = [seed for seed, path in paths.items() if not path.is_file()]
    if missing:  # caches are warm when the clock runs
        warm = arguments | {"seed": missing[0], "patience": 0.0}
        runner.run([Measurement("fast/warm-up", "reach", warm, threads=CORES, rounds=1)])
    for seed in missing:
        if runner.stopped:
            break
        one = Measurement(f"fast/{seed}", "reach", arguments | {"seed": seed}, threads=CORES, rounds=1)
        found = runner.run([one]).found[one.name]
        if found:
            paths[seed].parent.mkdir(parents=True, exist_ok=True)
            table = pd.DataFrame(found[0]).astype({"seconds": "float64", "frames": "float64"})
            tables.write_table(paths[seed], table.assign(when=when()))
    if fast_rows(runner.store).empty:
        return {}
    refresh_fast_target(out, runner.store)
    return {"fast": write_fast(runner.store)}


def measure_parity(runner: Runner, out: Path) -> dict[str, list[str]]:
    """Learning curves of ours and of SB3; what is there already is not run again."""
    from uavnav.algorithms.dqn import DQNConfig
    from uavnav.algorithms.ppo import PPOConfig

    seeds = parity.SEEDS
    if importlib.util.find_spec("stable_baselines3") is None:
        runner.say(f"parity: {PEERS['stable_baselines3']} is not installed: {INSTALL}")
        seeds = {cell: (many, 0, one, 0) for cell, (many, _, one, _) in seeds.items()}
    store = parity.Store(runner.store, parity.FRAMES)
    worlds = {"ppo": PPOConfig().n_worlds, "dqn": DQNConfig().n_worlds}
    failed: list[str] = []
    try:
        failed = parity.train(store, worlds, runner.store / "graphs", runner.say, seeds, at_once=CORES)
    except KeyboardInterrupt:
        runner.stopped = True
    picture = out.with_name(f"{out.stem}-parity.png")
    save_figure(picture, parity.draw(store, worlds))
    lines = parity.section(store, worlds, picture.name)
    return {"parity": [*lines, *(["", "Not measured:", "", *(f"- {why}" for why in failed)] if failed else [])]}


FLAGS: dict[str, Callable[[Runner, Path], dict[str, list[str]]]] = {
    "growth": measure_growth,
    "fast": measure_fast,
    "whole": measure_whole,
    "parity": measure_parity,
}


# -- the command ------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the world, training and its peers on this machine, and write it down; 40 minutes."""
    parser = Parser(prog="python -m uavnav.bench", description=main.__doc__)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--quick", action="store_true", help="a first impression, in at most 3 minutes")
    for flag, function in FLAGS.items():
        kind.add_argument(f"--{flag}", dest="flag", action="store_const", const=flag, help=function.__doc__)
    sections = ", ".join(SECTIONS)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=f"of {sections}")
    parser.add_argument("--out", type=Path, help=f"default: {OUT}; with --quick quick.md in the store")
    parser.add_argument("--store", type=Path, default=Path("bench"), help="folder for graphs and rows (default: bench)")
    arguments = parser.parse_args(argv)
    if arguments.flag and arguments.only:
        parser.error(f"--only: chooses from a plain run's sections; leave it out with --{arguments.flag}")
    out = arguments.out or (arguments.store / "quick.md" if arguments.quick else OUT)
    minutes = float("inf") if arguments.flag else MINUTES["quick" if arguments.quick else "full"]
    try:
        with stops_as_interrupts():
            for folder in (out.parent, arguments.store):
                folder.mkdir(parents=True, exist_ok=True)
                if not os.access(folder, os.W_OK):
                    raise PermissionError(f"{folder}: cannot be written; give a folder that can")
            if out.is_dir():
                raise IsADirectoryError(f"{out}: is a folder; give a file")
            console = Console(highlight=False, soft_wrap=True)
            runner = Runner(arguments.store, lambda line: console.print(line, markup=False), minutes)
            if arguments.flag:
                found = FLAGS[arguments.flag](runner, out)
            else:
                chosen = [one for one in plan(arguments.quick) if one.section in (arguments.only or SECTIONS)]
                results = runner.run(chosen, warm=arguments.quick)
                found = write_sections(results, arguments.store, only_measured=runner.stopped)
            if found:
                marks = [*(["one round each"] if arguments.quick else []), *(["cut short"] if runner.stopped else [])]
                write_file(out, found, time.monotonic() - runner.began, ", ".join(marks))
                print(f"wrote {out}")
    except (OSError, tables.RunError) as error:
        print(f"uavnav.bench: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("uavnav.bench: stopped while it wrote; the file is whole or as it was", file=sys.stderr)
        return 130
    if runner.stopped:
        kept = f"what was found so far is in {out}" if found else "nothing was found yet"
        print(f"uavnav.bench: stopped; {kept}", file=sys.stderr)
    return 130 if runner.stopped else 0


@contextlib.contextmanager
def stops_as_interrupts() -> Iterator[None]:
    """Let SIGTERM and SIGHUP be what Ctrl-C is, where they are not ignored, as under nohup."""
    heard = [number for number in STOPS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, signal.default_int_handler) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
