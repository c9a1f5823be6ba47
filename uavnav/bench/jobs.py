"""What `uavnav.bench` measures, one function a job: each runs in a process of its own and returns plain numbers.

`python -m uavnav.bench.jobs NAME '{"argument": ...}' LAUNCHED` prints the result as the last line, as JSON. LAUNCHED is
the time at which the process was started, so that start-up counts. A job ends when its standard input does.

Frames are per seed. A training job runs until it has seen `seconds` of steady work or `frames`, whichever is first.
"""

from __future__ import annotations

import copy
import functools
import importlib
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

Result = dict[str, Any]
KeepOn = Callable[[int], bool]

WHOLE = 1_000_000
"""Frames per seed of a whole run."""
ACTIVATION = "tanh"
"""Of every training run that is timed; all four take about the same time."""


THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class JobError(RuntimeError):
    """A job failed or took too long; the message is one line."""


class Job:
    """A job in a fresh process, started at once.

    Args:
        name: of a function of this module.
        arguments: its keyword arguments, as JSON holds them.
        threads: that its libraries may use.
        cache: the folder of compiled graphs.
    """

    def __init__(self, name: str, arguments: Result, threads: int, cache: Path) -> None:
        env = os.environ | dict.fromkeys(THREADS, str(threads)) | {"TORCHINDUCTOR_CACHE_DIR": str(cache.resolve())}
        command = [sys.executable, "-m", "uavnav.bench.jobs", name, json.dumps(arguments), str(time.time())]
        self.tree = 0.0
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the job
        listen, self._held = os.pipe()  # not Popen's own, which `communicate` closes
        self._process = subprocess.Popen(
            command, env=env, stdin=listen, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        os.close(listen)

    def result(self, timeout: float, sample: bool = False) -> Result:
        """Wait for what it found.

        Args:
            timeout: after so many seconds it is ended.
            sample: note the memory of the whole tree of processes too, as `tree` [GB].

        Raises:
            JobError: it failed, or took longer.
        """
        end = time.monotonic() + timeout
        while True:
            try:
                output, _ = self._process.communicate(timeout=0.5 if sample else max(end - time.monotonic(), 0.01))
                break
            except subprocess.TimeoutExpired:
                if time.monotonic() > end:
                    self.stop()
                    raise JobError(f"it took longer than {timeout:.0f} s") from None
                self.tree = max(self.tree, tree_memory(self._process.pid))
        if self._process.returncode:
            self._errors.seek(0)
            lines = self._errors.read().decode(errors="replace").strip().splitlines()
            raise JobError(lines[-1] if lines else f"exit status {self._process.returncode}")
        found: Result = json.loads(output.splitlines()[-1])
        return found | ({"tree": self.tree} if sample else {})

    def stop(self) -> None:
        """End the process and those that it started, if they still run."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        for process in _session(self._process.pid):  # shares of the seeds are groups of their own
            with suppress(ProcessLookupError):
                os.kill(int(process.name), signal.SIGKILL)
        self._process.wait()
        if self._process.stdout and not self._process.stdout.closed:
            self._process.stdout.close()
        if not self._errors.closed:
            self._errors.close()
            os.close(self._held)


def tree_memory(session: int) -> float:
    """What all processes of a session hold together, shared pages counted once [GB]; 0 where that is not known."""
    total = 0
    for process in _session(session):
        with suppress(OSError):  # it may have ended by now
            lines = (process / "smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total * 1024 / 1e9


def _session(number: int) -> list[Path]:
    """The folders in /proc of the processes of a session; none where there is no /proc."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):  # it may have ended by now
            if int((process / "stat").read_text().rpartition(")")[2].split()[3]) == number:
                found.append(process)
    return found


class Mark(NamedTuple):
    """How far a run was at some time."""

    frames: int  # per seed
    at: float  # [s] since the process was launched


class Enough(Exception):
    """A training run was watched for long enough."""


class Clock:
    """Notes how far a run is, and says when it was watched for long enough.

    Args:
        launched: when the process was started [s since the epoch].
        warm: frames from which the work is steady: everything is compiled, and DQN learns.
        frames: stop there at the latest.
        seconds: of steady work, after which to stop.
        least: frames before which seconds do not count.
    """

    def __init__(self, launched: float, warm: int, frames: int, seconds: float, least: int = 0) -> None:
        self.launched, self.warm, self.frames, self.seconds, self.least = launched, warm, frames, seconds, least
        self.marks: list[Mark] = []
        self._steady = 0

    def __call__(self, frames: int) -> bool:
        """Note the frames so far; whether to go on."""
        now = Mark(frames, time.time() - self.launched)
        self.marks.append(now)
        if frames < self.warm:
            return True
        self._steady += 1
        if self._steady == 1:
            self._began = now.at
        watched = frames >= self.least and now.at - self._began >= self.seconds
        return self._steady < 3 or (frames < self.frames and not watched)


def rate(marks: list[Mark]) -> float:
    """Frames/s per seed over marks, but for the first quarter of them, in which things are compiled and grow warm."""
    steady = marks[len(marks) // 4 :]
    return (steady[-1].frames - steady[0].frames) / (steady[-1].at - steady[0].at)


def whole_run(marks: list[Mark], starts: int, paper_starts: int) -> Result:
    """What a run of `WHOLE` frames takes, from the marks of a shorter one, and what its parts are.

    starts: frames before learning in the run that was watched, 0 for PPO; paper_starts: in the whole run.
    """
    after = rate([mark for mark in marks if mark.frames > starts] or marks)
    before = rate([mark for mark in marks if mark.frames <= starts]) if starts else after
    last = marks[-1]
    startup = last.at - min(last.frames, starts) / before - max(last.frames - starts, 0) / after
    whole = startup + paper_starts / before + (WHOLE - paper_starts) / after
    found = {"startup": startup, "rate": after, "whole": whole, "frames": last.frames}
    return found | ({"rate_before": before} if starts else {})


def peak_memory() -> float:
    """The most that this process had in memory at once [GB]."""
    with suppress(
        OSError
    ):  # Linux; what getrusage says there begins with the size of the process that started this one
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e9
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


# -- the world --------------------------------------------------------------------------------------------------------


def world(
    launched: float, batches: list[int], compiled: bool, seconds: float, meeting: str = "", copies: int = 1
) -> Result:
    """Steps/s of DroneEnv with random actions, by batch size: through the call that collectors make.

    With a folder to meet in, so many copies of this job measure in the same stretches of time, one a batch size.
    """
    import torch

    from uavnav.envs.env import DroneEnv

    found = {}
    for batch in batches:
        env = DroneEnv([batch])
        if compiled:
            env.compile()
        actions = itertools.cycle(torch.randint(100, (16, batch)).unbind(0))
        now = env.reset()
        for _ in range(3):
            _, now = env.step_and_maybe_reset(now.set("action", next(actions)))
        if meeting:
            _meet(Path(meeting), str(batch), copies)
        began, steps = time.perf_counter(), 0
        while time.perf_counter() - began < seconds or steps < 2:
            _, now = env.step_and_maybe_reset(now.set("action", next(actions)))
            steps += 1
        found[str(batch)] = steps * batch / (time.perf_counter() - began)
    return found


def _meet(folder: Path, name: str, copies: int, patience: float = 300.0) -> None:
    """Wait until so many processes are here, and go on at the same time."""
    (folder / f"{name}-{os.getpid()}").touch()
    end = time.monotonic() + patience
    while len(here := list(folder.glob(f"{name}-*"))) < copies:
        if time.monotonic() > end:
            raise TimeoutError(f"{len(here)} of {copies} processes came to measure {name}")
        time.sleep(0.01)
    last = max(path.stat().st_mtime for path in here)
    time.sleep(max(last + 0.2 - time.time(), 0))


def single(launched: float, which: str, seconds: float) -> Result:
    """Steps/s of one Gymnasium environment with random actions, resets included: `numpy` or `uavnav`."""
    env = _make_env(which)
    actions = np.random.default_rng(0).integers(env.action_space.n, size=4096)
    env.reset(seed=0)
    began, steps = time.perf_counter(), -300  # untimed: what is compiled or cached on first use
    while time.perf_counter() - began < seconds or steps < 2:
        if steps == 0:
            began = time.perf_counter()
        _, _, terminated, truncated, _ = env.step(actions[steps % 4096])
        if terminated or truncated:
            env.reset()
        steps += 1
    return {"rate": steps / (time.perf_counter() - began)}


def vector(launched: float, batches: list[int], seconds: float) -> Result:
    """Steps/s of `gymnasium.make_vec` with random actions, by the number of environments."""
    import gymnasium

    found = {}
    for batch in batches:
        env = gymnasium.make_vec("uavnav/Drone-v0", num_envs=batch)
        actions = np.random.default_rng(0).integers(100, size=(64, batch))
        env.reset(seed=0)
        began, steps = time.perf_counter(), -10
        while time.perf_counter() - began < seconds or steps < 2:
            if steps == 0:
                began = time.perf_counter()
            env.step(actions[steps % 64])
            steps += 1
        found[str(batch)] = steps * batch / (time.perf_counter() - began)
    return found


def _make_env(which: str) -> Any:
    """One environment as `gymnasium.make` gives it, with the same wrappers for both."""
    import gymnasium

    import uavnav  # noqa: F401 - registers ours

    if which == "uavnav":
        return gymnasium.make("uavnav/Drone-v0")
    gymnasium.register(id="uavnav/NumpyDrone-v0", entry_point="uavnav.bench.numpy_world:NumpyDroneEnv")
    return gymnasium.make("uavnav/NumpyDrone-v0")


# -- training: ours ---------------------------------------------------------------------------------------------------


class Stages:
    """Where the time goes: seconds in each of some functions, less what the others take inside them."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside: list[str] = []
        self.restart()

    def restart(self) -> None:
        """Forget what was timed so far."""
        self.seconds.clear()
        self._began = self._last = time.perf_counter()

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._inside:
            self.seconds[self._inside[-1]] += now - self._last
        self._last = now

    def wrap(self, owner: Any, name: str, stage: str) -> None:
        """Time a function of a module or a method of a class, if there is one of that name."""
        if not hasattr(owner, name):
            return
        function = getattr(owner, name)

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._charge()
            self._inside.append(stage)
            try:
                return function(*args, **kwargs)
            finally:
                self._charge()
                self._inside.pop()

        setattr(owner, name, timed)

    def shares(self) -> dict[str, float]:
        """Of the time since the last restart."""
        self._charge()
        total = self._last - self._began
        shares = {stage: seconds / total for stage, seconds in self.seconds.items()}
        return shares | {"other": 1 - sum(shares.values())}


def _time_stages(algorithm: str) -> Stages:
    from torchrl.collectors import Collector
    from torchrl.data import ReplayBuffer
    from torchrl.objectives import HardUpdate

    from uavnav.training.display import Display
    from uavnav.training.recorder import Recorder

    module, stages = importlib.import_module(f"uavnav.{algorithm}"), Stages()
    for owner, name, stage in (
        (Collector, "rollout", "collection"),
        (module, "estimate", "advantage"),
        (ReplayBuffer, "extend", "buffer"),
        (ReplayBuffer, "sample", "buffer"),
        (module, "learn", "update"),
        (HardUpdate, "step", "update"),
        (module, "diagnostics", "logging"),
        (Recorder, "add_episodes", "logging"),
        (Recorder, "add_progress", "logging"),
        (Recorder, "checkpoint", "logging"),
        (Display, "update", "logging"),
    ):
        stages.wrap(owner, name, stage)
    return stages


def _config(algorithm: str, settings: Result) -> Any:
    module = importlib.import_module(f"uavnav.{algorithm}")
    kind = {"ppo": "PPOConfig", "dqn": "DQNConfig"}[algorithm]
    return getattr(module, kind)(**{"activation": ACTIVATION, "total_frames": WHOLE} | settings)


def _train(
    algorithm: str, config: Any, out: str, keep_on: KeepOn = lambda frames: True, in_one_process: bool = False
) -> Any:
    """Train for as long as `keep_on`, called with the frames so far, says so; None where it was stopped."""
    train = importlib.import_module(f"uavnav.{algorithm}").train

    def tell(frames: int, rewards: list[float]) -> None:
        if not keep_on(frames):
            raise Enough

    with suppress(Enough):
        return (train.__wrapped__ if in_one_process else train)(config, out, quiet=True, tell=tell)


def ours(launched: float, algorithm: str, frames: int, seconds: float, stages: bool = False, **settings: Any) -> Result:
    """A run of ours, watched for a while; settings are fields of the configuration.

    With `stages` the time of each is taken, in one process on one core: what one of the processes of a run does.
    """
    config = _config(algorithm, settings)
    starts = getattr(config, "learning_starts", 0)
    warm = starts + 10 * config.n_worlds if starts else 3 * config.frames_per_batch
    clock = Clock(launched, warm, frames, seconds)
    timer = _time_stages(algorithm) if stages else None

    def keep_on(frame: int) -> bool:
        cold = not clock.marks or clock.marks[-1].frames < warm
        if timer is not None and cold and frame >= warm:
            timer.restart()
        return clock(frame)

    with tempfile.TemporaryDirectory() as scratch:
        _train(algorithm, config, f"{scratch}/run", keep_on, in_one_process=stages)
        meta = json.loads(Path(scratch, "run", "meta.json").read_text())
    how = {name: meta.get(name) for name in ("compiled", "threads", "processes")}
    shares = {} if timer is None else {"shares": timer.shares()}
    return _timed(clock.marks, starts, algorithm) | how | shares


def ours_whole(launched: float, algorithm: str, **settings: Any) -> Result:
    """A whole run of ours, to its end: seconds from the command to the folder."""
    config = _config(algorithm, settings)
    with tempfile.TemporaryDirectory() as scratch:
        run = _train(algorithm, config, f"{scratch}/run")
    return {"whole": time.time() - launched, "frames": run.frames, "peak": peak_memory()}


def buffer_memory(launched: float, n_seeds: int, frames: int) -> Result:
    """Peak memory of DQN until its buffer is full with so many frames a seed, and a few updates on the way.

    It is filled in many parallel worlds, so that it takes seconds, and saved every few.
    """
    n_worlds = max(frames // 625, 4)
    settings = {"n_worlds": n_worlds, "frames_per_update": n_worlds, "learning_starts": 4 * n_worlds}
    config = _config("dqn", settings | {"n_seeds": n_seeds, "total_frames": frames})
    with tempfile.TemporaryDirectory() as scratch:
        run = importlib.import_module("uavnav.dqn").train(
            config, out=f"{scratch}/run", quiet=True, checkpoint_seconds=5
        )
    return {"frames": run.frames, "peak": peak_memory(), "seconds": time.time() - launched}


def _timed(marks: list[Mark], starts: int, algorithm: str) -> Result:
    from uavnav.algorithms.dqn import DQNConfig

    return whole_run(marks, starts, DQNConfig.learning_starts if algorithm == "dqn" else 0) | {"peak": peak_memory()}


# -- training: peers --------------------------------------------------------------------------------------------------


def make_sb3(library: str, algorithm: str, env: Any, seed: int, n_envs: int = 1, **beyond: Any) -> Any:
    """Stable-Baselines3's or SBX's model with the preset `paper`; beyond: what differs from it.

    With n_envs parallel environments a rollout of PPO and the updates a frame of DQN stay what they are.
    """
    import torch

    from uavnav.algorithms.dqn import DQNConfig
    from uavnav.algorithms.ppo import PPOConfig

    activation = beyond.pop("activation", ACTIVATION)
    sizes = list(PPOConfig().hidden)
    if library == "sbx":
        import jax

        functions: dict[str, Any] = {"tanh": jax.nn.tanh, "relu": jax.nn.relu}
        kind: Any = {}
    else:
        functions = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
        kind = {"device": "cpu"}
    policy = {"net_arch": sizes, "activation_fn": functions[activation]}
    model = getattr(importlib.import_module(library), algorithm.upper())
    if algorithm == "ppo":
        ppo = PPOConfig()
        settings = {
            "learning_rate": ppo.lr,
            "n_steps": ppo.frames_per_batch // n_envs,
            "batch_size": ppo.minibatch_size,
            "n_epochs": ppo.epochs,
            "gamma": ppo.gamma,
            "gae_lambda": ppo.gae_lambda,
            "clip_range": ppo.clip_epsilon,
            "vf_coef": ppo.critic_coeff,
            "ent_coef": ppo.entropy_coeff,
            "max_grad_norm": ppo.max_grad_norm,
        }
    else:
        dqn = DQNConfig()
        settings = {
            "learning_rate": dqn.lr,
            "buffer_size": dqn.buffer_size,
            "learning_starts": dqn.learning_starts,
            "batch_size": dqn.batch_size,
            "gamma": dqn.gamma,
            "train_freq": max(dqn.frames_per_update // n_envs, 1),
            "gradient_steps": max(n_envs // dqn.frames_per_update, 1),
            "target_update_interval": dqn.target_update_frames,
            "exploration_fraction": dqn.exploration_fraction,
            "exploration_final_eps": dqn.epsilon_end,
        }
        if library != "sbx":  # which does not clip in DQN
            settings["max_grad_norm"] = dqn.max_grad_norm
    return model("MlpPolicy", env, seed=seed, policy_kwargs=policy, verbose=0, **kind, **settings | beyond)


def sb3(
    launched: float,
    algorithm: str,
    which: str,
    frames: int,
    seconds: float,
    learning_starts: int,
    library: str = "stable_baselines3",
    least: int = 0,
    whole: bool = False,
    stages: bool = False,
) -> Result:
    """A run of Stable-Baselines3 or SBX on one environment, watched for a while or, `whole`, to its end.

    With `stages` the time of each is taken.
    Where DQN is watched, epsilon is at its last value as soon as learning starts, as in nine tenths of a whole run.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    starts = learning_starts if algorithm == "dqn" else 0
    warm = starts + 100 if starts else 2048
    clock = Clock(launched, warm, frames, seconds, least)
    timer = _time_peers_stages() if stages else None

    class Watch(BaseCallback):  # type: ignore[misc]
        keep_on = True

        def _on_rollout_start(self) -> None:
            cold = not clock.marks or clock.marks[-1].frames < warm
            if timer is not None and cold and self.num_timesteps >= warm:
                timer.restart()
            self.keep_on = clock(self.num_timesteps)

        def _on_step(self) -> bool:
            return self.keep_on or whole

    beyond: Result = {} if whole or not starts else {"learning_starts": starts, "exploration_fraction": starts / WHOLE}
    make_sb3(library, algorithm, _make_env(which), seed=0, **beyond).learn(WHOLE, Watch())
    if whole:
        return {"whole": time.time() - launched, "frames": WHOLE, "peak": peak_memory()}
    shares = {} if timer is None else {"shares": timer.shares()}
    return _timed(clock.marks, starts, algorithm) | shares


def _time_peers_stages() -> Stages:
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

    stages = Stages()
    for owner, name, stage in (
        (PPO, "collect_rollouts", "collection"),
        (DQN, "collect_rollouts", "collection"),
        (RolloutBuffer, "compute_returns_and_advantage", "advantage"),
        (RolloutBuffer, "add", "buffer"),
        (ReplayBuffer, "add", "buffer"),
        (ReplayBuffer, "sample", "buffer"),
        (PPO, "train", "update"),
        (DQN, "train", "update"),
        (PPO, "dump_logs", "logging"),
        (DQN, "dump_logs", "logging"),
    ):
        stages.wrap(owner, name, stage)
    return stages


def cleanrl(
    launched: float, algorithm: str, frames: int, seconds: float, learning_starts: int, least: int = 0
) -> Result:
    """A run of the single-file PPO or DQN of `peers` on the NumPy world, watched for a while."""
    from uavnav.bench import peers

    make_env = functools.partial(_make_env, "numpy")
    starts = learning_starts if algorithm == "dqn" else 0
    clock = Clock(launched, starts + 100 if starts else 2048, frames, seconds, least)
    if algorithm == "ppo":
        peers.ppo(make_env, 0, clock)
    else:
        peers.dqn(make_env, 0, clock, learning_starts)
    return _timed(clock.marks, starts, algorithm)


# -- learning curves, for parity --------------------------------------------------------------------------------------


def curves_ours(launched: float, algorithm: str, seeds: list[int], paths: list[str], **settings: Any) -> Result:
    """Train seeds side by side, and keep the frame, steps and reward of each one's flights as Parquet."""
    config = _config(algorithm, settings | {"seed": seeds[0], "n_seeds": len(seeds)})
    with tempfile.TemporaryDirectory() as scratch:
        episodes = _train(algorithm, config, f"{scratch}/run").episodes
    for seed, path in zip(seeds, paths, strict=True):
        _keep(episodes.loc[episodes.seed == seed, ["frame", "steps", "reward"]], path)
    return {"seconds": time.time() - launched}


def curves_sb3(
    launched: float, algorithm: str, activation: str, seed: int, n_envs: int, frames: int, path: str
) -> Result:
    """Train one seed of Stable-Baselines3, in n_envs parallel worlds, and keep its flights as Parquet."""
    from stable_baselines3.common.callbacks import BaseCallback

    from uavnav.envs.sb3 import DroneVecEnv

    flights: list[tuple[int, int, float]] = []
    steps, sums = np.zeros(n_envs, int), np.zeros(n_envs)

    class Watch(BaseCallback):  # type: ignore[misc]
        def _on_step(self) -> bool:
            steps[:] += 1
            sums[:] += self.locals["rewards"]
            for row in np.flatnonzero(self.locals["dones"]):
                flights.append((self.num_timesteps, int(steps[row]), float(sums[row])))
                steps[row] = sums[row] = 0
            return True

    env = DroneVecEnv(n_envs, seed=seed) if n_envs > 1 else _make_env("numpy")
    model = make_sb3("stable_baselines3", algorithm, env, seed, n_envs, activation=activation)
    model.learn(frames, Watch())
    flights += [(model.num_timesteps, int(steps[row]), float(sums[row])) for row in np.flatnonzero(steps)]  # still open
    _keep(pd.DataFrame(flights, columns=["frame", "steps", "reward"]), path)
    return {"seconds": time.time() - launched}


def _keep(table: pd.DataFrame, path: str) -> None:
    from uavnav.bench.report import when
    from uavnav.runs.tables import write_table

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    table.attrs["when"] = when()
    write_table(Path(path), table.reset_index(drop=True))


# -- how soon a good policy is there ----------------------------------------------------------------------------------


def reach(launched: float, preset: str, seed: int, target: float, held_out: int, patience: float) -> Result:
    """Seconds from the command to the first policy of PPO whose mean reward on sets held out of training, sampled and
    with a cap of 10,000 steps, reaches the target.

    It trains on the train split without its last `held_out` sets, which are those that judge. Policies are set aside
    about once a second while training goes on and judged after it. `seconds` is None where none of those of the first
    `patience` seconds reaches the target.
    """
    from dataclasses import replace

    from uavnav.algorithms import ppo
    from uavnav.evaluate import fly
    from uavnav.policies import Policy
    from uavnav.tasks import layouts

    bank = layouts.load("train")
    kept: list[tuple[float, int, Any]] = []
    networks: list[Any] = []
    make_networks = ppo.make_networks

    def capture(config: Any) -> Any:
        networks[:] = made = make_networks(config)
        return made

    def keep_on(frame: int) -> bool:
        now = time.time() - launched
        if frame and (not kept or now - kept[-1][0] >= 1):
            kept.append((now, frame, copy.deepcopy(networks[0])))
        return now < patience

    def reward(index: int) -> float:
        policy = Policy(kept[index][2], "ppo", False, 0.0, config.world, config.reward)
        return float(fly({seed: policy}, bank[-held_out:], held_out, 10_000, config.world).episodes.reward.mean())

    ppo.make_networks = capture
    with tempfile.TemporaryDirectory() as scratch:
        layouts.save(bank[:-held_out], f"{scratch}/train.safetensors", seed=0, split="train")
        config = replace(ppo.PRESETS[preset], seed=seed, n_seeds=1, layouts=f"{scratch}/train.safetensors")
        _train("ppo", config, f"{scratch}/run", keep_on)
    found = _first(len(kept), lambda index: reward(index) >= target)
    seconds, frames = (None, None) if found is None else kept[found][:2]
    return {"seed": seed, "seconds": seconds, "frames": frames}


def _first(n: int, good: Callable[[int], bool], stride: int = 4) -> int | None:
    """The first good one of n that grow better: every fourth one is looked at, then those before the first good."""
    looked = [*range(stride - 1, n, stride), *([n - 1] if n % stride else [])]
    last = next((index for index in looked if good(index)), None)
    if last is None:
        return None
    return next((index for index in range(max(last - stride + 1, 0), last) if good(index)), last)


def _end_with_parent() -> None:
    """End at once when the one that holds the other end of the standard input is gone; a run's shares do so too."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


def main(argv: list[str]) -> None:
    """Run one job and print what it found."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    name, arguments, launched = argv
    print(json.dumps(globals()[name](float(launched), **json.loads(arguments))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
