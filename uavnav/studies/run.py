"""Carry a study out: workers as jobs of an engine, configurations put together and evaluated as they finish.

All is in files below the study's folder, so that the same command goes on after whatever has ended it.
Whether a job lives is what its own heartbeat says; an engine's word is a hint. A worker whose job has died
is given again, under its folder's next name, and goes on from its last snapshot.
"""

from __future__ import annotations

import contextlib
import functools
import secrets
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent import futures
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from uavnav import files, plugins
from uavnav.errors import ConfigError
from uavnav.evaluation import rows_across, together
from uavnav.evaluation.scripted import options
from uavnav.runs import ARENA, FINISHED, POLICY, STOP, VALUES, Run, progress, read_settings
from uavnav.runs.lately import all_seeds
from uavnav.runs.tables import RunError, lock, read_table, write_table
from uavnav.studies import Configuration, engines
from uavnav.studies.engines import Engine
from uavnav.tasks import layouts
from uavnav.training import heartbeat, machine, recorder, workers
from uavnav.training.recorder import STOPS, Interrupted, OtherRun, Recorder
from uavnav.training.workers import Worker

POLL_SECONDS = 1.0
ATTEMPTS = 3  # how often a job is given again without having got any further
QUEUE_SECONDS = 1800.0  # given to a job to begin, unless its engine says that it is queued
BEGIN_SECONDS = 600.0  # given to a job, once it has begun, until its first heartbeat
SILENT_SECONDS = 120.0  # without a heartbeat, after which a job counts as dead
IDLE_SECONDS = 3600.0  # without a job that lives, after which a study ends, unless jobs are queued
STUCK_SECONDS = 4 * 3600.0  # without a frame more, after which a job counts as dead although its heart beats
EPISODE_SECONDS = 48 * 3600.0  # given to an evaluation, whose heartbeat says no frames
ANSWER_SECONDS = 120.0  # given to an engine to answer a question
CHECK_SECONDS = 24 * 3600.0  # given to an engine to check its machines, which may wait in a queue
SAY_SECONDS = 60.0  # between two lines that say what a study waits for
THREADS = 1  # of a job: engines give each of them a core

EPISODES = "flying"  # begins the names of the files of an evaluation's job, in its configuration's folder

Tell = Callable[[Sequence["Work"]], None]
Say = Callable[[str], None]
Answer = TypeVar("Answer")


@dataclass
class Work:
    """A configuration that is not finished, as a study sees it."""

    configuration: Configuration
    workers: list[Worker] = field(default_factory=list)
    episodes: int = 0  # that were missing when its last evaluation began
    attempts: int = 0  # to fly it that left no file more
    problem: str = ""
    diverged: bool = False

    @property
    def frames(self) -> int:
        """Of all its seeds, so far."""
        return sum(worker.frames * worker.config.n_seeds for worker in self.workers)

    @property
    def rate(self) -> float:
        """Frames a second of all its seeds, now."""
        return sum(worker.rate * worker.config.n_seeds for worker in self.workers)

    @property
    def total(self) -> int:
        """Of all its seeds, in the end."""
        return self.configuration.config.frames * self.configuration.config.n_seeds


@dataclass
class Job:
    """A job that an engine was given."""

    work: Work
    worker: Worker | None  # None: an evaluation
    handle: Any = None
    told: dict[str, Any] = field(default_factory=dict)  # by its newest heartbeat
    # a name of its own, so that no former job is taken for this one
    number: str = field(default_factory=lambda: secrets.token_hex(4))
    since: float = 0.0  # when the engine took it
    moved: float = 0.0  # when its frames grew last
    heard: float = 0.0  # when its newest heartbeat, or its beginning, was seen
    spoke: bool = False  # there was a heartbeat
    unbegun: bool = False  # it was ended because it did not begin, which says nothing of its work

    @property
    def folder(self) -> Path:
        """Where its heartbeat is."""
        return self.work.configuration.out if self.worker is None else self.worker.folder

    def file(self, end: str) -> Path:
        """One of its files: `log` exists once it has begun, `ended` once it has ended by itself."""
        return (
            self.folder / f"{EPISODES}-{self.number}.{end}" if self.worker is None else self.worker.file(end)
        )

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

    def trains(self) -> bool:
        """Whether frames are missing, by its newest heartbeat; else it flies episodes."""
        return bool(self.told.get("frames", 0) < self.told.get("total", 0))


class Unanswered(RunError):
    """An engine does not answer a question in time."""


def asked(
    engine: Engine,
    question: Callable[[], Answer],
    seconds: float | None = None,
    wait: Say = lambda told: None,
) -> Answer:
    """What an engine answers in so many seconds, by default `ANSWER_SECONDS`; or the question's exception.

    wait: is told each minute how long that has lasted. Raises Unanswered where there is no answer.
    """
    seconds = ANSWER_SECONDS if seconds is None else seconds
    answer: Future[Answer] = Future()

    def ask() -> None:
        try:
            answer.set_result(question())
        except Exception as error:
            answer.set_exception(error)

    threading.Thread(target=ask, daemon=True).start()
    since = time.monotonic()
    while not futures.wait([answer], min(SAY_SECONDS, max(0.0, since + seconds - time.monotonic()))).done:
        told = f"engine={type(engine).__name__.lower()}: does not answer for {time.monotonic() - since:.0f} s"
        if time.monotonic() - since >= seconds:
            raise Unanswered(f"{told}; the same command goes on")
        wait(told)
    return answer.result()


def let_go(engine: Engine) -> None:
    """End an engine's jobs, if it still answers."""
    with contextlib.suppress(RunError):
        asked(engine, engine.close)


def trained(configuration: Configuration) -> bool:
    """Whether a configuration's rows are there. A repository may keep them without the policy."""
    meta = configuration.out / "meta.json"
    return meta.is_file() and read_settings(meta).get("status") == FINISHED


def unevaluated(configuration: Configuration) -> list[list[str]]:
    """The missing episodes that a configuration's study asks for: each the words of `uavnav evaluate`."""
    out, evaluations = configuration.out, configuration.evaluations
    more = ["--measures"] * configuration.measures
    missing = [
        [*options(one.header()), *more] for one in evaluations if not (out / one.file("evaluation")).exists()
    ]
    for bounds in ({"episodes": one.episodes, "max_steps": one.max_steps} for one in evaluations[:1]):
        ladders = [name for name in configuration.across if not (out / rows_across(name, **bounds)).exists()]
        missing += [[*options(bounds), "--alone", "--across", *ladders]] * bool(ladders)
    return missing


def evaluated(configuration: Configuration) -> bool:
    """Whether a configuration was evaluated as its study asks."""
    return not unevaluated(configuration)


def make_layouts(out: Path, numbers: Sequence[int]) -> None:
    """Write the training splits that a study asks for, unless they are there."""
    split = layouts.SPLITS["train"]
    for k in numbers:
        path = out / "layouts" / str(k) / "train.safetensors"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            layouts.save(layouts.generate(split.n, k, split.seed), path, seed=split.seed, split="train")


def check_folder(configuration: Configuration) -> None:
    """Raise an OtherRun, or another error of a `Recorder`, where its folder cannot be its own."""
    try:
        Recorder(configuration.out, configuration.config)
    except OtherRun as error:  # a study overwrites nothing
        raise OtherRun(str(error).removesuffix(", or overwrite=true")) from error


class Runner:
    """A study that is carried out.

    Args:
        out: its folder, which all machines see.
        seeds_per_worker: how many seeds a worker trains; by default the engine's own.
        policies: train a configuration again of which a repository has kept only the rows.
        checkpoint_seconds: the least time between two snapshots of a worker.
        tell: is told the configurations under way, now and then; say: what happens, a line each.

    Raises:
        ConfigError, LayoutError, RunError: before any work: a configuration's folder cannot be used.
    """

    def __init__(
        self,
        out: Path,
        configurations: Sequence[Configuration],
        engine: Engine,
        seeds_per_worker: int | None = None,
        policies: bool = False,
        checkpoint_seconds: float = recorder.CHECKPOINT_SECONDS,
        tell: Tell = lambda works: None,
        say: Say = print,
    ) -> None:
        self.out, self.engine, self.tell, self.say = out, engine, tell, say
        self.checkpoint_seconds = checkpoint_seconds
        self.per_worker = seeds_per_worker or engine.SEEDS_PER_WORKER
        self.policies = policies
        self.works = [Work(one) for one in configurations if not (self._trained(one) and evaluated(one))]
        for configuration in configurations:
            # the folder of a finished one, too, may contain another run
            check_folder(configuration)
        for work in self.works:
            if own := machine.own_parts(work.configuration.config):
                raise ConfigError(
                    f"{work.configuration.out}: {own} is known only to this process; give it as a plugin"
                )
        # what waits for a free slot; without a worker, an evaluation
        self._waiting: deque[tuple[Work, Worker | None]] = deque()
        self._running: list[Job] = []
        self._stop: int | None = None
        self._leaving: list[tuple[float, Job]] = []  # jobs that have said their last words, since when
        self._slots, self._answers = 0, True  # as the engine said last, and whether it did
        self._looked = self._said = 0.0
        self._lived = self._answered = time.monotonic()  # when a job lived, and the engine answered, last

    def _trained(self, configuration: Configuration) -> bool:
        return trained(configuration) and (not self.policies or (configuration.out / POLICY).exists())

    def run(self) -> list[Work]:
        """Train and evaluate what is left; returns the configurations that failed, each with its `problem`.

        Raises:
            ConfigError: the engine's machines do not see the folder.
            Interrupted: by SIGINT or SIGTERM; every worker was asked to save itself.
            RunError: another process does, the engine does not answer, or no job has lived for an hour.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(lock(self.out))
            self._check_engine()
            for number in STOPS:
                stack.callback(signal.signal, number, signal.signal(number, self._note))
            for work in self.works:
                self._begin(work)
            self._lived = self._said = self._answered = time.monotonic()
            while self._waiting or self._running:
                self._start()
                time.sleep(POLL_SECONDS)
                for job in self._over():
                    self._running.remove(job)
                    self._leaving.append((time.monotonic(), job))
                    self._ended(job)
                self._end_what_lingers()
                self._look()
                self._check_waiting()
                self.tell(self.works)
                if self._stop is not None:
                    raise self._stopped()
        return [work for work in self.works if work.problem]

    def _check_engine(self) -> None:
        """Have the engine check its machines; may be stopped meanwhile."""
        why = "its machines are checked, which may wait in a queue"
        check = functools.partial(self.engine.check, self.out)
        asked(self.engine, check, CHECK_SECONDS, lambda told: self.say(f"{told}: {why}"))

    def _ask(self, question: Callable[[], Answer], unknown: Answer) -> Answer:
        """What the engine answers; `unknown` where it does not, until that has lasted for an hour."""
        try:
            answer, self._answers = asked(self.engine, question), True
        except Unanswered:
            self._answers = False
            if time.monotonic() - self._answered > IDLE_SECONDS:
                raise
            return unknown
        self._answered = time.monotonic()
        return answer

    def _note(self, number: int, frame: object) -> None:
        self._stop = number

    def _begin(self, work: Work) -> None:
        """Write into a configuration's folder how it is carried out, and see what is left to do."""
        configuration, config = work.configuration, work.configuration.config
        if self._trained(configuration):
            self._waiting.appendleft((work, None))
            return
        own = Recorder(configuration.out, config)
        n = own.processes(
            -(-config.n_seeds // self.per_worker) if self.per_worker else machine.processes(config)
        )
        with machine.use_threads(THREADS), own:
            own.meta |= {"study": configuration.study}
            own.note(processes=n)
        work.workers = workers.split(config, configuration.out, n)
        for worker in work.workers:
            part = Configuration(worker.config, worker.folder, configuration.evaluations[:1])
            worker.done = trained(part) and evaluated(part)
            worker.frames = worker.config.frames if worker.done else 0
        self._waiting.extend((work, worker) for worker in work.workers if not worker.done)
        if all(worker.done for worker in work.workers):
            self._join(work)

    def _start(self) -> None:
        """Give the engine as many jobs as it takes: evaluations first, which finish configurations."""
        jobs = list[Job]()
        self._slots = self._ask(self.engine.slots, 0)
        while self._waiting and len(self._running) + len(jobs) < self._slots:
            job = Job(*self._waiting.popleft())
            if not job.work.problem:
                jobs.append(job)
        commands = [self._words(job) for job in jobs]
        handles = asked(self.engine, lambda: self.engine.start(commands)) if jobs else []
        for job, handle in zip(jobs, handles, strict=True):
            job.given(handle)
            self._running.append(job)

    def _words(self, job: Job) -> list[str]:
        configuration = job.work.configuration
        if job.worker is None:
            missing = unevaluated(configuration)
            job.work.episodes = len(missing)
            words = [
                "uavnav.cli.episodes",
                str(job.file("ended")),
                str(configuration.out),
                *missing[0],
                "--quiet",
            ]
            words += ["--plugins", ",".join(plugins.LOADED)] if plugins.LOADED else []
        else:
            how: dict[str, Any] = {"checkpoint_seconds": self.checkpoint_seconds}
            measures = {"measures": configuration.measures}
            headers = [one.header() | measures for one in configuration.evaluations[:1]]
            words = ["uavnav.cli.worker", *job.worker.prepare(THREADS, *headers, **how)]
        return engines.logged(["-m", *words], job.file("log"))

    def _over(self) -> list[Job]:
        """The jobs that have ended, by their engine's word or their files; and dead ones."""
        handles = [job.handle for job in self._running]
        ended = [False for _ in handles]
        if handles:
            ended = self._ask(lambda: [self.engine.ended(handle) for handle in handles], ended)
        look = time.monotonic() - self._looked >= heartbeat.SECONDS
        return [
            job
            for job, told in zip(self._running, ended, strict=True)
            if told or (look and (workers.last_words(job.file("ended")) or self._dead(job)))
        ]

    def _dead(self, job: Job) -> bool:
        """Whether a job is silent, stuck, or does not begin, for too long; then it is ended."""
        silence, now = job.silence(), time.monotonic()
        if not job.begun:
            what, since, limit = "has not begun", now - job.since, QUEUE_SECONDS
        elif job.spoke and silence < SILENT_SECONDS:
            limit = STUCK_SECONDS if job.trains() else EPISODE_SECONDS
            what, since = "has got no further", now - job.moved
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

    def _check_waiting(self) -> None:
        """Say now and then what the study waits for while no job lives; raises a RunError after an hour."""
        now, running, left = time.monotonic(), self._running, len(self._waiting)
        if not (running or left) or any(job.begun and now - job.heard < SAY_SECONDS for job in running):
            self._lived = self._said = now
            return
        begun = sum(job.begun for job in running)
        parts = [f"{begun} jobs that are silent"] * bool(begun)
        parts += [f"{len(running) - begun} jobs to begin"] * (begun < len(running))
        parts += [f"a machine for {left} jobs"] * (not running)
        what = f"no job has lived for {now - self._lived:,.0f} s, waiting for {' and '.join(parts)}"
        has = f"has {self._slots} slots" if self._answers else "does not answer"
        engine = f"engine={type(self.engine).__name__.lower()} {has}"
        if now - self._lived > IDLE_SECONDS:
            handles = [job.handle for job in running if not job.begun]
            if not self._ask(lambda: any(self.engine.queued(handle) for handle in handles), True):
                raise RunError(f"{_shown(self.out)}: {what}; {engine}; the same command goes on")
        if now - self._said >= SAY_SECONDS:
            self._said = now
            self.say(f"{_shown(self.out)}: {what}; {engine}")

    def _ended(self, job: Job) -> None:
        """See how a job ended: go on with its configuration, give it again, or note what is wrong."""
        said = workers.last_words(job.file("ended"))
        if job.worker is None:
            self._evaluated(job, said)
        elif "finished" in said:
            job.worker.done, job.worker.frames = True, job.worker.config.frames
            if all(worker.done for worker in job.work.workers):
                self._join(job.work)
        elif "error" in said:
            job.work.diverged = said.get("diverged", False)
            self._failed(job.work, str(said["error"]))
        elif job.worker.attempts >= ATTEMPTS:
            times = f"ended {1 + ATTEMPTS} times without a word"
            self._failed(job.work, f"{job.folder}: its job {times}, see {job.file('log')}")
        else:
            job.worker.attempts += not job.unbegun
            self.say(f"{_shown(job.folder)}: its job is gone; given again, from its last snapshot")
            self._waiting.appendleft((job.work, job.worker))

    def _evaluated(self, job: Job, said: dict[str, Any]) -> None:
        work, left = job.work, len(unevaluated(job.work.configuration))
        if not left:
            for path in work.configuration.out.glob(f"{EPISODES}-*.*"):
                files.remove(path)
            self.say(f"{_shown(work.configuration.out)}: finished")
        elif left < work.episodes:
            work.attempts = 0
            self._waiting.appendleft((work, None))
        elif not said and work.attempts < ATTEMPTS:
            work.attempts += not job.unbegun
            self.say(f"{_shown(work.configuration.out)}: the job of its evaluation is gone; given again")
            self._waiting.appendleft((work, None))
        else:
            self._failed(work, f"was not evaluated, see {job.file('log')}")

    def _failed(self, work: Work, problem: str) -> None:
        work.problem = problem
        self.say(f"{_shown(work.configuration.out)}: {problem}")

    def _join(self, work: Work) -> None:
        """Put a configuration's workers together, in its own folder."""
        configuration, n = work.configuration, len(work.workers)
        try:
            with (
                machine.use_threads(THREADS),
                Recorder(configuration.out, configuration.config) as own,
            ):
                compiled = all(Run(worker.folder).meta["compiled"] for worker in work.workers)
                own.meta |= {"study": configuration.study}
                own.note(compiled=compiled, processes=n)
                _join_episodes(configuration, [worker.folder for worker in work.workers])
                workers.join(own, work.workers)
                self._stop = self._stop or own.stop
        except (OSError, RunError) as error:
            self._failed(work, str(error))
            return
        if evaluated(configuration):
            self.say(f"{_shown(configuration.out)}: finished")
        else:
            self._waiting.appendleft((work, None))

    def _look(self) -> None:
        """See now and then how far the workers are, and write how far their configurations are."""
        now = time.monotonic()
        if now - self._looked < heartbeat.SECONDS:
            return
        self._looked = now
        for work in self.works:
            for worker in work.workers:
                worker.rate = 0.0
        training = [(job.work, job.worker, job.told) for job in self._running if job.worker is not None]
        for _, worker, told in training:
            worker.rate = told.get("rate", 0.0)
            if told.get("frames", 0) > worker.frames:
                worker.frames, worker.attempts, worker.lately = told["frames"], 0, told["lately"]
        for work in {id(work): work for work, _, _ in training}.values():
            frames = min(worker.frames for worker in work.workers)
            rates = [worker.rate for worker in work.workers if worker.rate]
            with contextlib.suppress(OSError):
                heartbeat.tell(
                    work.configuration.out,
                    frames,
                    work.configuration.config.frames,
                    min(rates, default=None),
                    all_seeds([worker.lately for worker in work.workers]),
                )

    def _stopped(self) -> Interrupted:
        """Ask the workers to save themselves, and wait until they have."""
        # who flies episodes has nothing to save
        self._running = [job for job in self._running if job.worker is not None and job.trains()]
        for job in self._running:
            with contextlib.suppress(OSError):
                (job.folder / STOP).touch()
        limit = time.monotonic() + workers.STOP_SECONDS
        while self._running and time.monotonic() < limit:
            time.sleep(POLL_SECONDS)
            for job in self._over():
                self._running.remove(job)
        number = self._stop or signal.SIGTERM
        what = (
            f"{_shown(self.out)}: stopped by {signal.Signals(number).name}; the same command goes on from "
            "there"
        )
        return Interrupted(what, number, 0, wanted=False)


def _join_episodes(configuration: Configuration, folders: Sequence[Path]) -> None:
    """Put what the workers have evaluated together, in the order of one evaluation of all seeds."""
    beside = [name for name in (ARENA, VALUES) if all((folder / name).exists() for folder in folders)]
    for name in (*beside, *reversed(configuration.episodes)):  # rows last: who finds them has the others too
        parts = [read_table(folder / name, {"seed": "int64"}, "delete it") for folder in folders]
        table = together(parts)
        table.attrs = parts[0].attrs
        write_table(configuration.out / name, table)


def _shown(path: Path) -> str:
    """A path from here, where that is short."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
