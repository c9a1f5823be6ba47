"""Carry a study out: its shares as jobs of an engine, its cells put together and evaluated as they finish.

Everything lies in files below the study's folder, so that the same command goes on after whatever has ended it. An
engine's word that a job runs is a hint: whether a job lives is what its own heartbeat says, and how it ended is in the
files. A share whose job has died is given again, under its folder's next name, and goes on from its last snapshot.
"""

from __future__ import annotations

import contextlib
import functools
import json
import queue
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from uavnav import files, plugins
from uavnav.errors import ConfigError
from uavnav.evaluation import rows_across
from uavnav.runs import ARENA, FINISHED, MOST_SEEDS, POLICY, STOP, VALUES, Run, progress, read_settings
from uavnav.runs.tables import RunError, lock, read_table, write_table
from uavnav.studies import Cell, engines
from uavnav.studies.engines import Engine
from uavnav.tasks import layouts
from uavnav.training import heartbeat, machine, recorder, workers
from uavnav.training.config import TrainConfig
from uavnav.training.recorder import STOPS, Interrupted, Recorder

POLL_SECONDS = 1.0
STOP_SECONDS = 60.0
"""Given to shares to save themselves."""
ATTEMPTS = 3
"""How often a job is given again without having got any further."""
QUEUE_SECONDS = 1800.0
"""Given to a job to begin, unless its engine says that it is queued."""
BEGIN_SECONDS = 600.0
"""Given to a job, once it has begun, until its first heartbeat."""
SILENT_SECONDS = 120.0
"""Without a heartbeat, after which a job counts as dead."""
IDLE_SECONDS = 3600.0
"""Without any job that lives, after which a study ends, unless its engine says that jobs are queued."""
STUCK_SECONDS = 4 * 3600.0
"""Without a frame more, after which a job counts as dead although its heart beats."""
FLIGHT_SECONDS = 48 * 3600.0
"""Given to an evaluation, whose heartbeat says no frames."""
ANSWER_SECONDS = 120.0
"""Given to an engine to answer a question."""
CHECK_SECONDS = 24 * 3600.0
"""Given to an engine to check its machines, which may wait in a queue."""
SAY_SECONDS = 60.0
"""Between two lines that say what a study waits for."""

CHECK = "its machines are checked, which may wait in a queue"
FLIGHTS = "flying"
"""Begins the names of the files of an evaluation's job, in its cell's folder."""

Tell = Callable[[Sequence["Work"]], None]
Say = Callable[[str], None]
Answer = TypeVar("Answer")


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
    attempts: int = 0  # to fly it that left no file more
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


@dataclass
class Job:
    """A job that an engine was given."""

    work: Work
    share: Share | None  # None: an evaluation
    handle: Any = None
    told: dict[str, float] = field(default_factory=dict)  # by its newest heartbeat
    number: str = field(default_factory=lambda: secrets.token_hex(4))  # so that no former job is taken for this one
    since: float = 0.0  # when the engine took it
    moved: float = 0.0  # when its frames grew last
    heard: float = 0.0  # when its newest heartbeat, or its beginning, was seen
    spoke: bool = False  # there was a heartbeat
    unbegun: bool = False  # it was ended because it did not begin, which says nothing of its work

    @property
    def folder(self) -> Path:
        """Where its heartbeat is."""
        return self.work.cell.out if self.share is None else self.share.folder

    def file(self, end: str) -> Path:
        """One of its files: `job` describes it, `log` exists once it has begun, `ended` once it has ended by itself."""
        stem = self.folder / f"{FLIGHTS}-{self.number}" if self.share is None else self.folder
        return stem.with_name(f"{stem.name}.{end}")

    @property
    def begun(self) -> bool:
        """Whether it runs, or has run, on some machine."""
        return self.file("log").exists()

    def given(self, handle: Any) -> None:
        """An engine has taken it."""
        self.handle, self.told = handle, progress(self.folder)
        self.since = self.moved = self.heard = time.monotonic()

    def silence(self) -> float:
        """How long ago its heart was seen to beat [s]; 0 while it waits to begin."""
        now, told = time.monotonic(), progress(self.folder)
        if told != self.told:
            self.moved = now if told.get("frames") != self.told.get("frames") else self.moved
            self.told, self.heard, self.spoke = told, now, True
        elif not self.begun:
            self.heard = now
        return now - self.heard

    def last_words(self) -> dict[str, Any]:
        """What it wrote when it ended; empty where it has not, or died."""
        try:
            found = files.read_json(self.file("ended"))
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


class Unanswered(RunError):
    """An engine does not answer a question in time."""


def asked(
    engine: Engine, question: Callable[[], Answer], seconds: float | None = None, wait: Say = lambda told: None
) -> Answer:
    """What an engine answers.

    Args:
        seconds: given to the engine; by default `ANSWER_SECONDS`.
        wait: is told each minute how long that has lasted.

    Raises:
        Unanswered: it does not answer within that time.
        Exception: whatever the question raises.
    """
    seconds = ANSWER_SECONDS if seconds is None else seconds
    heard: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()

    def ask() -> None:
        try:
            heard.put((question(), None))
        except Exception as error:
            heard.put((None, error))

    threading.Thread(target=ask, daemon=True).start()
    name, since = type(engine).__name__.lower(), time.monotonic()
    while True:
        try:
            answer, error = heard.get(timeout=min(SAY_SECONDS, max(0.0, since + seconds - time.monotonic())))
            break
        except queue.Empty:
            told = f"engine={name}: does not answer for {time.monotonic() - since:.0f} s"
            if time.monotonic() - since >= seconds:
                raise Unanswered(f"{told}; the same command goes on") from None
            wait(told)
    if error is not None:
        raise error
    found: Answer = answer
    return found


def let_go(engine: Engine) -> None:
    """End an engine's jobs, if it still answers."""
    with contextlib.suppress(RunError):
        asked(engine, engine.close)


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


class Runner:
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
        for cell in cells:
            if cell.config.n_seeds > MOST_SEEDS:
                raise ConfigError(f"{cell.out}: n_seeds={cell.config.n_seeds}; give at most {MOST_SEEDS:,}")
        self.works = [Work(cell) for cell in cells if not (self._trained(cell) and evaluated(cell))]
        for cell in cells:
            Recorder(cell.out, cell.config)  # the folder of a finished one, too, may hold another run
        for work in self.works:
            if own := machine.own_parts(work.cell.config):
                raise ConfigError(f"{work.cell.out}: {own} is known to this process alone; give it as a plugin")
        self._stop: int | None = None
        self._leaving: list[tuple[float, Job]] = []  # jobs that have said their last words, since when
        self._slots = 0
        self._looked = self._said = 0.0
        self._lived = self._answered = time.monotonic()  # when a job lived, and the engine answered, last

    def _trained(self, cell: Cell) -> bool:
        return trained(cell) and (not self.policies or (cell.out / POLICY).exists())

    def run(self) -> list[Work]:
        """Train and evaluate what is left.

        Returns:
            The cells that failed, each with its `problem`.

        Raises:
            ConfigError: the engine's machines do not see the folder.
            Interrupted: by SIGINT or SIGTERM; every share was asked to save itself.
            RunError: another process carries it out, its engine does not answer, or no job has lived for an hour.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(lock(self.out))
            self._check_engine()
            stack.enter_context(self._signals())
            for work in self.works:
                if not self._trained(work.cell):
                    self._begin(work)
            waiting = deque((work, share) for work in self.works for share in work.shares if not share.done)
            flights = deque(work for work in self.works if self._trained(work.cell))
            running: list[Job] = []
            self._finish_what_is_trained(flights)
            self._lived = self._said = self._answered = time.monotonic()
            while waiting or flights or running:
                self._start(waiting, flights, running)
                time.sleep(POLL_SECONDS)
                for job in self._over(running):
                    running.remove(job)
                    self._leaving.append((time.monotonic(), job))
                    self._ended(job, waiting, flights)
                self._end_what_lingers()
                self._look(running)
                self._check_waiting(running, len(waiting) + len(flights))
                self.tell(self.works)
                if self._stop is not None:
                    raise self._stopped(running)
        return [work for work in self.works if work.problem]

    def _check_engine(self) -> None:
        """Have the engine check its machines, which may wait in a queue and may be stopped there."""
        asked(
            self.engine, lambda: self.engine.check(self.out), CHECK_SECONDS, lambda told: self.say(f"{told}: {CHECK}")
        )

    def _ask(self, question: Callable[[], Answer], unknown: Answer) -> Answer:
        """What the engine answers; `unknown` where it does not, until that has lasted for an hour."""
        try:
            answer = asked(self.engine, question)
        except Unanswered:
            if time.monotonic() - self._answered > IDLE_SECONDS:
                raise
            return unknown
        self._answered = time.monotonic()
        return answer

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
        work.shares = [Share(path, part) for path, part in workers.split(config, work.cell.out, n).items()]
        for share in work.shares:
            part = Cell(share.config, share.folder, work.cell.evaluation)
            share.done = trained(part) and evaluated(part)
            share.frames = share.config.frames if share.done else 0

    def _finish_what_is_trained(self, flights: deque[Work]) -> None:
        for work in self.works:
            if work.shares and all(share.done for share in work.shares):
                self._join(work, flights)

    def _start(self, waiting: deque[tuple[Work, Share]], flights: deque[Work], running: list[Job]) -> None:
        """Give the engine as many jobs as it takes: evaluations first, which finish cells."""
        jobs: list[tuple[Job, list[str]]] = []
        self._slots = self._ask(self.engine.slots, 0)
        while len(running) + len(jobs) < self._slots and (flights or waiting):
            if flights:
                job = Job(flights.popleft(), None)
                jobs.append((job, self._evaluation(job)))
            else:
                work, share = waiting.popleft()
                if not work.problem:
                    job = Job(work, share)
                    jobs.append((job, self._training(job, share)))
        commands = [words for _, words in jobs]
        handles = asked(self.engine, lambda: self.engine.start(commands)) if jobs else []
        for (job, _), handle in zip(jobs, handles, strict=True):
            job.given(handle)
            running.append(job)

    def _over(self, running: Sequence[Job]) -> list[Job]:
        """The jobs that have ended, by their engine's word or, now and then, by their files; and dead ones."""
        handles = [job.handle for job in running]
        unknown = [False for _ in handles]
        ended = self._ask(lambda: [self.engine.ended(handle) for handle in handles], unknown) if handles else unknown
        look = time.monotonic() - self._looked >= heartbeat.SECONDS
        return [
            job
            for job, told in zip(running, ended, strict=True)
            if told or (look and (job.last_words() or self._dead(job)))
        ]

    def _dead(self, job: Job) -> bool:
        """Whether a job is silent, stuck, or does not begin, for longer than its engine explains; then it is ended."""
        silence, now = job.silence(), time.monotonic()
        if not job.begun:
            what, since, limit = "has not begun", now - job.since, QUEUE_SECONDS
        elif job.spoke and silence < SILENT_SECONDS:
            trains = job.told.get("frames", 0) < job.told.get("total", 0)
            what, since, limit = "has got no further", now - job.moved, STUCK_SECONDS if trains else FLIGHT_SECONDS
        else:
            what, since, limit = "has been silent", silence, SILENT_SECONDS if job.spoke else BEGIN_SECONDS
        if since < limit or self._ask(lambda: self.engine.queued(job.handle), True):
            return False
        self._ask(lambda: self.engine.cancel(job.handle), None)
        job.unbegun = not job.begun
        self.say(f"{_shown(job.folder)}: its job {what} for {since:.0f} s and counts as dead")
        return True

    def _end_what_lingers(self) -> None:
        """End a job's process that does not end after its last words, and would keep its place."""
        now = time.monotonic()
        for since, job in [one for one in self._leaving if now - one[0] > SILENT_SECONDS]:
            self._leaving.remove((since, job))
            if not self._ask(functools.partial(self.engine.ended, job.handle), True):
                self._ask(functools.partial(self.engine.cancel, job.handle), None)

    def _check_waiting(self, running: Sequence[Job], left: int) -> None:
        """Say now and then what the study waits for while no job lives.

        Raises:
            RunError: that has lasted for an hour, and no job is queued.
        """
        now = time.monotonic()
        if not (running or left) or any(job.begun and now - job.heard < SAY_SECONDS for job in running):
            self._lived = self._said = now
            return
        begun = sum(job.begun for job in running)
        parts = [f"{begun} jobs that are silent"] * bool(begun)
        parts += [f"{len(running) - begun} jobs to begin"] * (begun < len(running))
        parts += [f"a machine for {left} jobs"] * (not running)
        what = f"no job has lived for {now - self._lived:,.0f} s, waiting for {' and '.join(parts)}"
        has = f"has {self._slots} slots" if now - self._answered < SAY_SECONDS else "does not answer"
        engine = f"engine={type(self.engine).__name__.lower()} {has}"
        if now - self._lived > IDLE_SECONDS:
            handles = [job.handle for job in running if not job.begun]
            if not self._ask(lambda: any(self.engine.queued(handle) for handle in handles), True):
                raise RunError(f"{_shown(self.out)}: {what}; {engine}; the same command goes on")
        if now - self._said >= SAY_SECONDS:
            self._said = now
            self.say(f"{_shown(self.out)}: {what}; {engine}")

    def _training(self, job: Job, share: Share) -> list[str]:
        work = job.work
        share.folder = workers.take(share.folder)
        threads = machine.threads(work.cell.config, len(work.shares))
        described = workers.described(share.folder, share.config, self.checkpoint_seconds, threads=threads)
        described |= {"evaluation": work.cell.evaluation, "folder": str(Path.cwd())}
        files.write(job.file("job"), json.dumps(described).encode())
        words = ["-m", "uavnav.cli.worker", *plugins.LOADED, str(job.file("job"))]
        return engines.logged(words, job.file("log"))

    def _evaluation(self, job: Job) -> list[str]:
        cell, missing = job.work.cell, unflown(job.work.cell)
        job.work.flights = len(missing)
        words = ["-m", "uavnav.cli.flights", str(job.file("ended")), str(cell.out), *missing[0], "--quiet"]
        words += ["--plugins", ",".join(plugins.LOADED)] if plugins.LOADED else []
        return engines.logged(words, job.file("log"))

    def _ended(self, job: Job, waiting: deque[tuple[Work, Share]], flights: deque[Work]) -> None:
        """See how a job ended: go on with its cell, give it again, or note what is wrong."""
        if job.share is None:
            self._flown(job, flights)
        else:
            self._trained_share(job, job.share, waiting, flights)

    def _flown(self, job: Job, flights: deque[Work]) -> None:
        work, left = job.work, len(unflown(job.work.cell))
        if not left:
            for path in work.cell.out.glob(f"{FLIGHTS}-*.*"):
                files.remove(path)
            self.say(f"{_shown(work.cell.out)}: finished")
        elif left < work.flights:
            work.attempts = 0
            flights.append(work)
        elif not job.last_words() and work.attempts < ATTEMPTS:
            work.attempts += not job.unbegun
            self.say(f"{_shown(work.cell.out)}: the job of its evaluation is gone; given again")
            flights.append(work)
        else:
            self._failed(work, f"was not evaluated, see {job.file('log')}")

    def _trained_share(self, job: Job, share: Share, waiting: deque[tuple[Work, Share]], flights: deque[Work]) -> None:
        work, said = job.work, job.last_words()
        share.rate = 0.0
        if "finished" in said:
            share.done, share.frames = True, share.config.frames
            if all(other.done for other in work.shares):
                self._join(work, flights)
        elif "error" in said:
            work.diverged = said.get("diverged", False)
            self._failed(work, str(said["error"]))
        elif share.attempts >= ATTEMPTS:
            log = job.file("log")
            self._failed(work, f"{share.folder}: its job ended {1 + ATTEMPTS} times without a word, see {log}")
        else:
            share.attempts += not job.unbegun
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
                own.meta |= {"study": work.cell.study}
                own.note(compiled=compiled, processes=len(folders))
                _join_flights(work.cell, folders)
                workers.join(own, folders)
                self._stop = self._stop or own.stop
        except (OSError, RunError) as error:
            self._failed(work, str(error))
            return
        if evaluated(work.cell):
            self.say(f"{_shown(work.cell.out)}: finished")
        else:
            flights.append(work)

    def _look(self, running: Sequence[Job]) -> None:
        """See now and then how far the shares are, and write how far their cells are."""
        now = time.monotonic()
        if now - self._looked < heartbeat.SECONDS:
            return
        self._looked = now
        flying: dict[int, list[Share]] = {}
        for job in running:
            if (share := job.share) is not None:
                share.rate = job.told.get("rate", 0.0)
                if job.told.get("frames", 0) > share.frames:
                    share.frames, share.attempts = int(job.told["frames"]), 0
                flying.setdefault(id(job.work), []).append(share)
        for work in self.works:
            if id(work) in flying and not trained(work.cell):
                frames = min(share.frames for share in work.shares)
                rate = min(share.rate for share in flying[id(work)])
                with contextlib.suppress(OSError):
                    heartbeat.tell(work.cell.out, frames, work.cell.config.frames, rate or None)

    def _ended_by_engine(self, job: Job) -> bool:
        with contextlib.suppress(RunError):  # it does not answer
            return asked(self.engine, lambda: self.engine.ended(job.handle))
        return False

    def _stopped(self, running: Sequence[Job]) -> Interrupted:
        """Ask the shares to save themselves, and wait until they have."""
        left = [job for job in running if job.share is not None]  # an evaluation has nothing to save
        for job in left:
            with contextlib.suppress(OSError):
                (job.folder / STOP).touch()
        limit = time.monotonic() + STOP_SECONDS
        while left and time.monotonic() < limit:
            time.sleep(POLL_SECONDS)
            left = [job for job in left if not (job.last_words() or self._ended_by_engine(job))]
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
