"""Bad input gets one line that names what is wrong and what would be right, a typed exception in the library, a
non-zero status on the command line, and nothing half-written: how a case of it is written, and tried both ways.
"""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from spoiling import nothing

import uavnav
from uavnav import ConfigError, LayoutError, PolicyError, RunError
from uavnav import evaluation as evaluation
from uavnav.__main__ import main
from uavnav.algorithms import dqn, ppo
from uavnav.evaluation import verify as verification
from uavnav.runs import POLICY, Run
from uavnav.tasks import layouts
from uavnav.training.recorder import Interrupted
from uavnav.views import render as rendering

RECIPES = Path(__file__).parent.parent / "recipes"
PPO = {
    "total_frames": 64,
    "frames_per_batch": 64,
    "minibatch_size": 32,
    "epochs": 1,
    "n_seeds": 2,
    "hidden": [8],
    "compile": "off",
}
DRONE = "uavnav/Drone-v0"
DQN = {"total_frames": 256, "learning_starts": 32, "hidden": [8], "compile": "off"}


class Case(NamedTuple):
    """How to spoil a part of a good folder, what to call then, and what must be answered."""

    name: str
    part: str  # that is spoilt, below the folder
    spoil: Callable[[Path], Any]  # it; may return a context to stay in
    call: Callable[[Path], Any] | None  # on the folder; None where only the command line can be wrong
    error: type[Exception]
    wrong: str  # in the message
    right: str  # too
    command: list[str]  # the same on the command line; none where it has no such words


# -- the good folder -----------------------------------------------------------------------------------------------


def make_good(folder):
    """A bank, a finished and evaluated run, a half-finished one, a policy, a thesis: all as they should be."""
    layouts.save(layouts.generate(20, 4, seed=0), folder / "bank", seed=0, split="train")
    run = ppo.train(ppo.PPOConfig(**PPO), out=folder / "run", quiet=True)
    evaluation.evaluate_run(run, episodes=2, max_steps=5)
    for path in run.path.glob("*-test-2-5.parquet"):  # stands for 200 sets and 10,000 steps
        shutil.copy(path, path.with_name(f"{path.name.partition('-')[0]}.parquet"))
    with pytest.raises(Interrupted):
        dqn.train(dqn.DQNConfig(**DQN), out=folder / "half", quiet=True, until=128)
    shutil.copy(run.path / POLICY, folder / "policy")
    (folder / "thesis").mkdir()
    (folder / "thesis" / "chapter.txt").write_text("It was a dark and stormy night.")
    return folder


def tree(folder):
    """Every path below a folder, with its bytes."""
    return {str(path.relative_to(folder)): held(path) for path in folder.rglob("*")}


def held(path):
    """A file's bytes; of one that is too large to be read, how many."""
    if not path.is_file():
        return None
    size = path.stat().st_size
    return path.read_bytes() if size < 2**30 else size


def words(settings):
    return [f"{key}={value}".replace(" ", "") for key, value in settings.items()]


EVALUATE = ["evaluate", "{}/run", "--episodes", "2", "--max-steps", "5"]
VERIFY = ["verify", "{}/run"]
RENDER = ["render", "{}/policy", "--out", "{}/flight.png", "--steps", "2"]
NEW_BANK = ["layouts", "--out", "{}/new"]
REPORT = ["report", "{}/run"]


def train_ppo(folder, out="run", overwrite=False, **settings):
    return ppo.train(ppo.PPOConfig(**PPO | settings), folder / out, overwrite, quiet=True)


def train_dqn(folder, out="half", **settings):
    return dqn.train(dqn.DQNConfig(**DQN | settings), folder / out, quiet=True)


def read(folder):
    return Run(folder / "run")


def read_evaluation(folder):
    return Run(folder / "run").evaluation()


def evaluate(folder, **how):
    return evaluation.evaluate_run(Run(folder / "run"), **{"episodes": 2, "max_steps": 5} | how)


def verify(folder):
    return verification.verify(Run(folder / "run"), quiet=True)


def fly(folder, **how):
    return evaluation.evaluate_policy(uavnav.baselines.straight_ahead, **how)


def save_bank(path, n=1):
    layouts.save(layouts.generate(n), path, seed=0, split="test")


def save_picture(path):
    rendering.save([np.zeros((600, 800, 3), dtype=np.uint8)], path, 30)


def gym_env(**options):
    env = uavnav.gym.DroneGymEnv(layouts="test")
    env.reset(options=options)
    return env


def bank(name, spoil, wrong, right="make one with uavnav layouts", part="bank"):
    check = ["layouts", "--check", "{}/" + part]
    return Case(f"bank: {name}", part, spoil, lambda f: layouts.check(f / part), LayoutError, wrong, right, check)


def bank_for(name, call, wrong, right, command=(), spoil=nothing):
    return Case(f"bank: {name}", "bank", spoil, call, LayoutError, wrong, right, list(command))


def policy(
    name,
    spoil,
    wrong="not a readable policy file",
    right="of a finished run",
    part="policy",
    seed=None,
    error=PolicyError,
):
    command = [word.replace("/policy", "/" + part) for word in RENDER] + (["--seed", str(seed)] if seed else [])
    load = lambda f: uavnav.load_policy(f / part, seed)  # noqa: E731
    return Case(f"policy: {name}", part, spoil, load, error, "{}/" + part + ": " + wrong, right, command)


def run(part, name, spoil, wrong, right, call=read, command=EVALUATE, error=RunError):
    part = f"run/{part}".rstrip("/")
    return Case(f"{part}: {name}", part, spoil, call, error, "{}/" + part + ": " + wrong, right, command)


def out(name, part, spoil, wrong, right, target="run", overwrite=False, **settings):
    place = target if target[0] == "/" else "{}/" + target
    command = ["ppo", *words(PPO | settings | {"out": place, "overwrite": str(overwrite).lower()})]
    call = lambda f: train_ppo(f, target, overwrite, **settings)  # noqa: E731
    return Case(f"out: {name}", part, spoil, call, RunError, wrong, right, command)


def half(name, spoil, wrong, right, **settings):
    part, command = "half/checkpoint", ["dqn", *words(DQN | settings), "out={}/half"]
    return Case(f"half: {name}", part, spoil, lambda f: train_dqn(f, **settings), RunError, wrong, right, command)


def config(settings, right, wrong=None, algorithm="ppo"):
    kind = {"ppo": ppo.PPOConfig, "dqn": dqn.DQNConfig}[algorithm]
    [(key, value)] = settings.items()
    if key == "world" and isinstance(value, dict):
        [(field, value)] = value.items()
        key = f"world.{field}"
    command = [algorithm, *words({key: "null" if value is None else value})]
    build = lambda f: kind.from_mapping(settings)  # noqa: E731
    wrong = f"{key}={value}; " if wrong is None else wrong
    return Case(f"config: {algorithm} {key}={value!r}", "thesis", nothing, build, ConfigError, wrong, right, command)


def word(name, wrong, right, *command):
    """Wrong on the command line alone."""
    return Case(f"word: {name}", "thesis", nothing, None, SystemExit, wrong, right, list(command))


def argument(name, call, wrong, right, *command, error=ValueError):
    return Case(f"argument: {name}", "thesis", nothing, call, error, wrong, right, list(command))


GOOD_BANK, READABLE = "make one with uavnav layouts", "{}/bank: not a readable bank"
SHAPE, ANEW, FOLDER = "a bank has the shape [n > 0, k, 3]", "generate it anew", "that can be written"
WHOLE, NUMBER, FILE, OVERWRITE = "give a whole number", "give a number", "or a file's path", "overwrite=true"
HEADER, RUN = "its tensors do not fit its header", "give a run's folder"
DAMAGED, NO_RUN, EMPTY = "missing or damaged", "config.yaml: not a run's", "give a new or empty folder"
EXECUTED = "mkdir executed"
LONG = "x" * 300  # more than a file's name may have


# -- trying --------------------------------------------------------------------------------------------------------


def said(case, folder, text):
    """One line with both fragments."""
    assert "\n" not in text
    for fragment in (case.wrong, case.right):
        assert fragment.replace("{}", str(folder)) in text, text


@contextlib.contextmanager
def spoilt(case, folder):
    """Within, the folder is spoilt, and it must stay just so."""
    held = case.spoil(folder / case.part)
    with held or contextlib.nullcontext():
        before = tree(folder)
        yield
        after = tree(folder)
    if case.name.startswith("half"):  # meta.json tells when the run was last tried
        before.pop("half/meta.json"), after.pop("half/meta.json")
    assert after == before


def by_name(cases):
    return [pytest.param(case, id=case.name) for case in cases]


COMMANDS = ("layouts", "evaluate", "verify", "render", "report", "play")


def in_the_library(case, folder):
    """The call is answered with one line of a typed exception, and nothing changes."""
    with spoilt(case, folder), pytest.raises(case.error) as refused:
        case.call(folder)
    assert type(refused.value) is case.error
    said(case, folder, str(refused.value))


def on_the_command_line(case, folder, capfd):
    """The command is answered with one line and a status, and nothing changes."""
    program, *arguments = [word.replace("{}", str(folder)) for word in case.command]
    with spoilt(case, folder):
        try:
            status = main([program, *arguments] if program in COMMANDS else ["train", program, *arguments])
        except SystemExit as stop:
            status = stop.code
    printed, complained = capfd.readouterr()
    assert status == 2
    assert printed == ""
    assert complained.startswith(f"uavnav {program if program in COMMANDS else 'train'}: ")
    assert complained.endswith("\n")
    said(case, folder, complained[:-1])
