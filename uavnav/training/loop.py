"""The one training loop: the only home of recorder, display, collector, workers and checkpoints.

An algorithm's module imports `train` from here. The `make` of its configuration gives the loop a `Trainee`.
On Ctrl-C the recorder notes the signal (`Recorder._note_stop`), and the end of the iteration, or of several
in one call, saves the run.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import ReplayBuffer

from uavnav.acting import Actor
from uavnav.envs.env import DroneEnv
from uavnav.errors import ConfigError, told
from uavnav.runs import Run, Threads
from uavnav.runs.tables import RunError
from uavnav.settings import Count, Seconds, checked
from uavnav.training import loggers, machine, probes, weights, workers
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, plain
from uavnav.training.display import Display, Tell
from uavnav.training.recorder import CHECKPOINT_SECONDS, Recorder, free_folder

Row = Mapping[str, Tensor | float]  # what an algorithm says in a row of progress: [A], or one number for all


Fit = Callable[[Recorder, bool, Tell | None], Run]
"""Trains a recorder's run in this process: (recorder, quiet, tell) -> the run."""


class Several(Protocol):
    """Iterations of a run that are one call, for an algorithm whose `Trainee` has them as `rounds`."""

    def ready(self, env: DroneEnv, frames: int) -> bool:
        """Whether the next ones after so many frames can be, of which none gives a row of progress."""

    def run(self, env: DroneEnv) -> TensorDictBase:
        """Do them, learning included; their steps [A, W, T]."""


class Trainee(Protocol):
    """What the loop needs of an algorithm: all seeds' agents, A of them, in W environments each. It may have
    `rounds` too, see `Several`.
    """

    actor: Actor
    parts: Mapping[str, Stateful]  # what a snapshot must contain besides the environment and the actor
    replay: ReplayBuffer | None  # a buffer whose rows a snapshot must contain too

    def learn(self, batch: TensorDictBase, frames: int) -> Row | None:
        """The algorithm: learn from the newest steps [A, W, T], after so many frames per seed."""

    def networks(self) -> Mapping[str, nn.Module]:
        """What the policy file keeps; `policy` is the one that acts."""


def alone(recorder: Recorder, quiet: bool = False, tell: Tell | None = None) -> Run:
    """Train all seeds of a run in this process: environment, algorithm, loop."""
    session = Session(recorder, quiet, tell)
    env = make_env(session.config, session.compile)
    trainee: Trainee = session.config.make(session.compile)
    with session.open(env, trainee.actor, trainee.networks(), trainee.parts, trainee.replay):
        for frames, batch in session.batches(getattr(trainee, "rounds", None)):
            row = trainee.learn(batch, frames)
            if row is not None:
                session.log(row)
        return session.finish()


class Session:
    """A run that this process trains: its batches, rows of progress, snapshots and folder."""

    def __init__(self, recorder: Recorder, quiet: bool, tell: Tell | None) -> None:
        self.recorder, self.config = recorder, recorder.config
        self.display = Display(self.config, quiet, tell)
        self.compile = recorder.repeat(machine.decide(self.config))

    @contextlib.contextmanager
    def open(
        self,
        env: DroneEnv,
        actor: Actor,
        networks: Mapping[str, nn.Module],
        parts: Mapping[str, Stateful],
        replay: ReplayBuffer | None = None,
    ) -> Iterator[None]:
        """Begin or go on with the run: from here on, its folder exists. Arguments as of `Trainee`."""
        weights.check(networks, self.config)
        sizes = [one.nbytes for net in networks.values() for one in net.parameters()]
        machine.keep_memory_flat(max(sizes), sum(sizes))
        self.env, self.actor, self.networks, self.replay = env, actor, networks, replay
        self.parts: Mapping[str, Stateful] = {"env": env, "actions": actor, **parts}
        self._poses = probes.poses(self.config.make_task()).to(self.config.device)
        with self.recorder, self.display, machine.little_garbage():
            self.recorder.note(compiled=self.compile)
            self.frames = self._logged = self.recorder.resume(self.parts, replay)
            self.display.begin(self.recorder, self.frames)
            yield

    def batches(self, rounds: Several | None = None) -> Iterator[tuple[int, TensorDictBase]]:
        """The run's steps [A, W, T], one batch after the other, each with the frames per seed at its end.

        Between two batches, what was learned is saved where a snapshot is due. rounds: does what lies between
        two rows of progress where it can, and there is no batch of that.
        """
        collected = iter(make_collector(self.env, self.actor, self.config))
        self._began = time.perf_counter()
        while self.frames < self.config.frames:
            if rounds is not None and rounds.ready(self.env, self.frames):
                self._note(rounds.run(self.env))
            else:
                batch = next(collected)
                self._note(batch)
                yield self.frames, batch
            self.recorder.tell(self.frames)
            self.recorder.checkpoint(self.frames, self.parts, self.replay)

    def _note(self, batch: TensorDictBase) -> None:
        """Keep the episodes that end in a batch, and count its frames."""
        self.recorder.add_episodes(batch["next"], self.frames)
        self.frames += batch.shape[1:].numel()

    def log(self, row: Row) -> None:
        """Keep a row of progress, with statistics of the policy's hidden units."""
        row = {**row, **probes.units(self.networks["policy"], self._poses)}
        now = time.perf_counter()
        rate = (self.frames - self._logged) / (now - self._began)
        self._began, self._logged = now, self.frames
        self.recorder.add_progress(self.frames, **row, frames_per_second=rate)
        self.display.update(self.frames, self.recorder.look(self.env.state, self.frames))

    def finish(self) -> Run:
        """Write the run's policies and tables."""
        self.recorder.add_open_episodes(self.env.state, self.frames)
        return self.recorder.finish(weights.serialize(self.networks, self.config, self.actor), self.frames)


def train(
    config: TrainConfig,
    out: str | Path | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    until: int | None = None,
    tell: Tell | None = None,
    processes: int | None = None,
    threads: int | None = None,
    logger: str | Sequence[str] = loggers.NONE,
    fit: Fit = alone,
) -> Run:
    """Train one agent a seed and keep the run in a folder.

    Args:
        config: the settings of an algorithm.
        out: the run's folder; by default runs/<algorithm>-<preset>/<activation>, and what differs
            from the preset behind it.
        overwrite: start anew where the folder contains a run.
        quiet: show no progress.
        checkpoint_seconds: the least time between two snapshots, from which an unfinished run is resumed.
        until: stop after so many frames per seed, as if by a signal.
        tell: called now and then with the frames per seed so far and each seed's reward per 1,000 frames,
            lately and with open episodes (see `uavnav.runs.lately`).
        processes: how many workers train the seeds; by default one for each core, where that pays.
        threads: of each of them; by default one, or two where four seeds or more are in one process.
        logger: `tensorboard`, `wandb`, a list of both, or `none`: logs besides the tables, see
            `uavnav.loggers`.
        fit: trains all seeds in this process, instead of `alone`; a recipe has one.

    Returns:
        The finished run; at once, where the folder already contains this very run.

    Raises:
        ConfigError, LayoutError, RunError: before anything is written.
        Interrupted: by SIGINT, SIGTERM or `until`; saved, or the message says what is not.
    """
    if not isinstance(config, TrainConfig):
        raise ConfigError(f"config={told(config)}; give a configuration, such as PPOConfig()")
    if out is not None and not isinstance(out, (str, Path)):
        raise ConfigError(f"out={told(out)}; give a folder")
    checked("overwrite", overwrite, bool)
    checked("quiet", quiet, bool)
    if tell is not None and not callable(tell):
        raise ConfigError(f"tell={told(tell)}; give a function of frames and rewards")
    checked("checkpoint_seconds", checkpoint_seconds, Seconds)
    until = checked("until", until, Count | None)
    names = loggers.chosen(logger)
    folder = Path(out) if out else free_folder(config)
    logs = loggers.Logs(names, folder, config.algorithm, plain(config))
    recorder = Recorder(folder, config, overwrite, checkpoint_seconds, until, logs if names else None)
    if recorder.finished:
        run = Run(recorder.path)
        loggers.log_finished(run, names)
        return run
    config.check_machine()
    config.try_task()
    if processes is not None and (type(processes) is not int or not 1 <= processes <= config.n_seeds):
        raise ConfigError(
            f"processes={told(processes)}; give a whole number from 1 to n_seeds={config.n_seeds}"
        )
    n = recorder.processes(processes or machine.processes(config) if fit is alone else 1)
    if n > 1 and fit is not alone:
        raise RunError(
            f"out={folder}: its run began in {n} processes; uavnav train {config.algorithm} goes on with it"
        )
    if n > 1 and (own := machine.own_parts(config)):
        raise ConfigError(f"processes={n}: {own} is known only to this process; give processes=1")
    threads = checked("threads", threads, Threads | None) or machine.threads(config, n)
    with contextlib.closing(logs), machine.use_threads(threads):
        return _together(recorder, n, threads, quiet, tell) if n > 1 else fit(recorder, quiet, tell)


def _together(recorder: Recorder, n: int, threads: int, quiet: bool, tell: Tell | None) -> Run:
    config = recorder.config
    compile = recorder.repeat(machine.decide(config))
    with recorder, Display(config, quiet, tell) as display:
        recorder.note(compiled=compile, processes=n)
        done = min(worker.saved() for worker in workers.split(config, recorder.path, n))
        display.begin(recorder, done)
        return workers.train(recorder, n, threads, display.update)


def make_env(config: TrainConfig, compile: bool) -> DroneEnv:
    """The environment of a run: [n_seeds, n_envs] rows of its task."""
    shape = [config.n_seeds, config.n_envs]
    env = DroneEnv(shape, device=config.device, seeds=config.seeds, task=config.make_task())
    return env.compile() if compile else env


class Rollouts(Collector):  # type: ignore[misc]
    """TorchRL's collector, whose batch is one call of a graph where the environment is compiled; an actor of
    another class is asked step by step.
    """

    def iterator(self) -> Iterator[TensorDictBase]:
        if not self.env.compiled or type(self.policy) is not Actor:
            yield from super().iterator()
        while True:
            yield self.env.steps(self.policy, self.frames_per_batch)


def make_collector(env: DroneEnv, actor: Actor, config: TrainConfig) -> Rollouts:
    """From where the environment is: batches [A, W, T], one after the other."""
    return Rollouts(
        env,
        actor,
        frames_per_batch=config.n_seeds * config.frames_per_iteration,
        total_frames=-1,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
        trust_policy=True,
        use_buffers=False,
        return_same_td=True,
        device=config.device,
    )
