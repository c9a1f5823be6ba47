"""Carry a study out: its shares as jobs of an engine, its cells put together and evaluated as they finish.

Everything lies in files below the study's folder, so that the same command goes on after whatever has ended it. A share
whose job has died is given again, under its folder's next name, and goes on from its last snapshot.
"""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import files, plugins
from uavnav.evaluate import rows_across
from uavnav.help.choices import ConfigError
from uavnav.runs import ARENA, FINISHED, POLICY, STOP, VALUES, Run, progress, read_settings
from uavnav.runs.tables import RunError, lock, read_table, write_table
from uavnav.studies import Cell, engines
from uavnav.studies.engines import Engine
from uavnav.tasks import layouts
from uavnav.training import machine, recorder, shares
from uavnav.training.config import TrainConfig
from uavnav.training.recorder import STOPS, Interrupted, Recorder

POLL_SECONDS = 1.0
STOP_SECONDS = 60.0
"""Given to shares to save themselves."""
ATTEMPTS = 3
"""How often a share is given without having got any further."""

Tell = Callable[[Sequence["Work"]], None]
Say = Callable[[str], None]


@dataclass
class Share:
    """A share of a cell's seeds, and how often it was given since it last got further."""

    folder: Path
    config: TrainConfig
    frames: int = 0
    rate: float = 0.0  # frames a second of each seed, while it runs
    attempts: int = 0
    done: bool = False


@dataclass
class Work:
    """A cell that is not finished, as a study sees it."""

    cell: Cell
    shares: list[Share] = field(default_factory=list)
    flights: int = 0  # that were missing when its last evaluation began
    problem: str = ""
    diverged: bool = False

    @property
    def frames(self) -> int:
        """Of all its seeds, so far."""
        return sum(share.frames * share.config.n_seeds for share in self.shares)

    @property
    def rate(self) -> float:
        """Frames a second of all its seeds, now."""
        return sum(share.rate * share.config.n_seeds for share in self.shares)

    @property
    def total(self) -> int:
        """Of all its seeds, in the end."""
        return self.cell.config.frames * self.cell.config.n_seeds


def trained(cell: Cell) -> bool:
    """Whether a cell's rows are there. A repository may keep them without the policy."""
    meta = cell.out / "meta.json"
    return meta.is_file() and read_settings(meta).get("status") == FINISHED


def unflown(cell: Cell) -> list[list[str]]:
    """The flights of a cell that its study asks for and that are missing: each the words of `uavnav evaluate`."""
    if cell.evaluation is None:
        return []
    bounds = {key: value for key, value in cell.evaluation.items() if key != "layouts"}
    missing = [] if (cell.out / cell.flights[0]).exists() else [_words(cell.evaluation)]
    ladders = [name for name in cell.across if not (cell.out / rows_across(name, **bounds)).exists()]
    return missing + [[*_words(bounds), "--alone", "--across", *ladders]] * bool(ladders)


def evaluated(cell: Cell) -> bool:
    """Whether a cell was flown as its study asks."""
    return not unflown(cell)


def _words(protocol: Mapping[str, Any]) -> list[str]:
    return [part for key, value in protocol.items() for part in (f"--{key.replace('_', '-')}", str(value))]


def make_banks(out: Path, numbers: Sequence[int]) -> None:
    """Write the training banks that a study asks for, unless they are there."""
    split = layouts.SPLITS["train"]
    for k in numbers:
        path = out / "banks" / str(k) / "train.safetensors"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            layouts.save(layouts.generate(split.n, k, split.seed), path, seed=split.seed, split="train")


class Study:
    """A study that is carried out.

    Args:
        out: its folder, which all machines see.
        cells: of the study; what is finished of them is left as it is.
        engine: where its jobs run.
        seeds_per_share: how many seeds a job trains; by default the engine's own.
        policies: train a cell again of which a repository has kept the rows alone.
        checkpoint_seconds: the least time between two snapshots of a share.
        tell: is told the cells under way, now and then.
        say: is told what happens, a line each.

    Raises:
        ConfigError, LayoutError, RunError: before any work: a cell's folder holds something else, or cannot be written.
    """

    def __init__(
        self,
        out: Path,
        cells: Sequence[Cell],
        engine: Engine,
        seeds_per_share: int | None = None,
        policies: bool = False,
        checkpoint_seconds: float = recorder.CHECKPOINT_SECONDS,
        tell: Tell = lambda works: None,
        say: Say = print,
    ) -> None:
        self.out, self.engine, self.tell, self.say = out, engine, tell, say
        self.checkpoint_seconds = checkpoint_seconds
        self.per_share = seeds_per_share or engine.SEEDS_PER_SHARE
        self.policies = policies
        self.works = [Work(cell) for cell in cells if not (self._trained(cell) and evaluated(cell))]
        for cell in cells:
            Recorder(cell.out, cell.config)  # the folder of a finished one, too, may hold another run
        for work in self.works:
            if own := machine.own_parts(work.cell.config):
                raise ConfigError(f"{work.cell.out}: {own} is known to this process alone; give it as a plugin")
        self._stop: int | None = None
        self._looked = 0.0

    def _trained(self, cell: Cell) -> bool:
        return trained(cell) and (not self.policies or (cell.out / POLICY).exists())

    def run(self) -> list[Work]:
        """Train and evaluate what is left.

        Returns:
            The cells that failed, each with its `problem`.

        Raises:
            ConfigError: the engine's machines do not see the folder.
            Interrupted: by SIGINT or SIGTERM; every share was asked to save itself.
            RunError: another process carries this study out.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(lock(self.out))
            self.engine.check(self.out)  # which may wait in a queue, and may be stopped there
            stack.enter_context(self._signals())
            for work in self.works:
                if not self._trained(work.cell):
                    self._begin(work)
            waiting = deque((work, share) for work in self.works for share in work.shares if not share.done)
            flights = deque(work for work in self.works if self._trained(work.cell))
            running: list[tuple[Any, Work, Share | None]] = []
            self._finish_what_is_trained(flights)
            while waiting or flights or running:
                self._start(waiting, flights, running)
                time.sleep(POLL_SECONDS)
                for entry in [entry for entry in running if self.engine.ended(entry[0])]:
                    running.remove(entry)
                    self._ended(entry[1], entry[2], waiting, flights)
                self._look(running)
                self.tell(self.works)
                if self._stop is not None:
                    raise self._stopped(running)
        return [work for work in self.works if work.problem]

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        before = {number: signal.signal(number, self._note) for number in STOPS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: object) -> None:
        self._stop = number

    def _begin(self, work: Work) -> None:
        """Write into a cell's folder how it is carried out, and see which shares there are."""
        config = work.cell.config
        own = Recorder(work.cell.out, config)
        n = own.processes(-(-config.n_seeds // self.per_share) if self.per_share else machine.processes(config))
        with machine.use_threads(machine.threads(config, n)), own:
            own.note(processes=n)
        work.shares = [Share(path, part) for path, part in shares.split(config, work.cell.out, n).items()]
        for share in work.shares:
            part = Cell(share.config, share.folder, work.cell.evaluation)
            share.done = trained(part) and evaluated(part)
            share.frames = share.config.frames if share.done else 0

    def _finish_what_is_trained(self, flights: deque[Work]) -> None:
        for work in self.works:
            if work.shares and all(share.done for share in work.shares):
                self._join(work, flights)

    def _start(
        self,
        waiting: deque[tuple[Work, Share]],
        flights: deque[Work],
        running: list[tuple[Any, Work, Share | None]],
    ) -> None:
        """Give the engine as many jobs as it takes: evaluations first, which finish cells."""
        jobs: list[tuple[list[str], Work, Share | None]] = []
        while len(running) + len(jobs) < self.engine.slots() and (flights or waiting):
            if flights:
                work = flights.popleft()
                work.flights = len(unflown(work.cell))
                jobs.append((self._evaluation(work), work, None))
            else:
                work, share = waiting.popleft()
                if not work.problem:
                    jobs.append((self._training(work, share), work, share))
        handles = self.engine.start([words for words, _, _ in jobs]) if jobs else []
        running += [(handle, work, share) for handle, (_, work, share) in zip(handles, jobs, strict=True)]

    def _training(self, work: Work, share: Share) -> list[str]:
        share.folder = shares.take(share.folder)
        threads = machine.threads(work.cell.config, len(work.shares))
        described = shares.described(share.folder, share.config, self.checkpoint_seconds, threads=threads)
        job = share.folder.with_name(f"{share.folder.name}.job")
        described |= {"evaluation": work.cell.evaluation, "folder": str(Path.cwd())}
        files.write(job, json.dumps(described).encode())
        words = ["-m", "uavnav.train.share", *plugins.LOADED, str(job)]
        return engines.logged(words, job.with_suffix(".log"))

    def _evaluation(self, work: Work) -> list[str]:
        words = ["-m", "uavnav", "evaluate", str(work.cell.out), *unflown(work.cell)[0], "--quiet"]
        words += ["--plugins", ",".join(plugins.LOADED)] if plugins.LOADED else []
        return engines.logged(words, self._log(work))

    def _log(self, work: Work) -> Path:
        return work.cell.out / "evaluation.log"

    def _ended(self, work: Work, share: Share | None, waiting: deque[tuple[Work, Share]], flights: deque[Work]) -> None:
        """See how a job ended: go on with its cell, give it again, or note what is wrong."""
        if share is None:
            left = len(unflown(work.cell))
            if not left:
                self._log(work).unlink(missing_ok=True)
                self.say(f"{_shown(work.cell.out)}: finished")
            elif left < work.flights:
                flights.append(work)
            else:
                self._failed(work, f"was not evaluated, see {self._log(work)}")
            return
        share.rate = 0.0
        said = _said(share.folder.with_name(f"{share.folder.name}.ended"))
        if "finished" in said:
            share.done, share.frames = True, share.config.frames
            if all(other.done for other in work.shares):
                self._join(work, flights)
        elif "error" in said:
            work.diverged = said.get("diverged", False)
            self._failed(work, said["error"])
        elif share.attempts >= ATTEMPTS:
            log = share.folder.with_name(f"{share.folder.name}.log")
            self._failed(work, f"{share.folder}: its job ended {ATTEMPTS} times without a word, see {log}")
        else:
            share.attempts += 1
            self.say(f"{_shown(share.folder.with_suffix(''))}: its job is gone; given again, from its last snapshot")
            waiting.appendleft((work, share))

    def _failed(self, work: Work, problem: str) -> None:
        work.problem = problem
        self.say(f"{_shown(work.cell.out)}: {problem}")

    def _join(self, work: Work, flights: deque[Work]) -> None:
        """Put a cell's shares together, in its own folder."""
        try:
            folders = [share.folder for share in work.shares]
            threads = machine.threads(work.cell.config, len(folders))
            with machine.use_threads(threads), Recorder(work.cell.out, work.cell.config) as own:
                compiled = all(Run(folder).meta["compiled"] for folder in folders)
                own.note(compiled=compiled, processes=len(folders))
                _join_flights(work.cell, folders)
                shares.join(own, folders)
                self._stop = self._stop or own.stop
        except (OSError, RunError) as error:
            self._failed(work, str(error))
            return
        if evaluated(work.cell):
            self.say(f"{_shown(work.cell.out)}: finished")
        else:
            flights.append(work)

    def _look(self, running: Sequence[tuple[Any, Work, Share | None]]) -> None:
        """Read now and then how far the shares are, and write how far their cells are."""
        now = time.monotonic()
        if now - self._looked < recorder.PROGRESS_SECONDS:
            return
        self._looked = now
        flying: dict[int, list[Share]] = {}
        for _, work, share in running:
            if share is not None:
                told = progress(share.folder)
                share.rate = told.get("rate", 0.0)
                if told.get("frames", 0) > share.frames:
                    share.frames, share.attempts = int(told["frames"]), 0
                flying.setdefault(id(work), []).append(share)
        for work in self.works:
            if id(work) in flying and not trained(work.cell):
                frames = min(share.frames for share in work.shares)
                rate = min(share.rate for share in flying[id(work)])
                with contextlib.suppress(OSError):
                    recorder.tell(work.cell.out, frames, work.cell.config.frames, rate or None)

    def _stopped(self, running: Sequence[tuple[Any, Work, Share | None]]) -> Interrupted:
        """Ask the shares to save themselves, and wait until they have."""
        folders = [share.folder for _, _, share in running if share is not None]
        for folder in folders:
            (folder / STOP).touch()
        limit = time.monotonic() + STOP_SECONDS
        left = list(running)
        while left and time.monotonic() < limit:
            time.sleep(POLL_SECONDS)
            left = [entry for entry in left if not self.engine.ended(entry[0])]
        number = self._stop or signal.SIGTERM
        what = f"{_shown(self.out)}: stopped by {signal.Signals(number).name}; the same command goes on from there"
        return Interrupted(what, number, 0, wanted=False)


def _join_flights(cell: Cell, folders: Sequence[Path]) -> None:
    """Put what the shares have flown together, in the order of one evaluation of all seeds: mode by mode."""
    beside = [name for name in (ARENA, VALUES) if all((folder / name).exists() for folder in folders)]
    for name in (*beside, *reversed(cell.flights)):  # rows last: who finds them has the others too
        parts = [read_table(folder / name, {"seed": "int64"}, "delete it") for folder in folders]
        table = pd.concat(parts, ignore_index=True)
        if "mode" in table:
            table = table.sort_values("mode", kind="stable", ignore_index=True)
        table.attrs = parts[0].attrs
        write_table(cell.out / name, table)


def _shown(path: Path) -> str:
    """A path from here, where that is short."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _said(path: Path) -> dict[str, Any]:
    """What a job has written, or nothing."""
    try:
        found = files.read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
