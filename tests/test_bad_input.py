"""Bad input gets one line that names what is wrong and what would be right, a typed exception in the library, a
non-zero status on the command line, and nothing half-written: one table of all such cases, each tried both ways.
"""

import contextlib
import errno
import json
import math
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from filelock import FileLock
from safetensors import safe_open
from safetensors.torch import save_file

import uavnav
from uavnav import ConfigError, LayoutError, PolicyError, RunError, runs
from uavnav import evaluate as evaluation
from uavnav import render as rendering
from uavnav import verify as verification
from uavnav.algorithms import dqn, ppo
from uavnav.runs import POLICY, Run
from uavnav.tasks import layouts
from uavnav.training import recorder
from uavnav.training.recorder import Interrupted

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


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A bank, a finished and evaluated run, a half-finished one, a policy, a thesis: all as they should be."""
    folder = tmp_path_factory.mktemp("bad input") / "good"
    layouts.save(layouts.generate(20, 4, seed=0), folder / "bank", seed=0, split="train")
    run = ppo.train(ppo.PPOConfig(**PPO), out=folder / "run", quiet=True)
    evaluation.evaluate_run(run, episodes=2, max_steps=5)
    with pytest.raises(Interrupted):
        dqn.train(dqn.DQNConfig(**DQN), out=folder / "half", quiet=True, until=128)
    shutil.copy(run.path / POLICY, folder / "policy")
    (folder / "thesis").mkdir()
    (folder / "thesis" / "chapter.txt").write_text("It was a dark and stormy night.")
    return folder


def tree(folder):
    """Every path below a folder, with its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


# -- ways to spoil ---------------------------------------------------------------------------------------------------


def nothing(path):
    """The call alone is wrong."""


def missing(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def a_folder(path):
    missing(path)
    path.mkdir()


def a_file(path):
    missing(path)
    path.write_text("x")


def itself(path):
    missing(path)
    path.symlink_to(path)


def written(content):
    return lambda path: put(path, content)


def put(path, content):
    """Write a file, whatever there was."""
    if isinstance(content, str):
        content = content.encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def cut(share):
    def spoil(path):
        content = path.read_bytes()
        put(path, content[: int(len(content) * share)])

    return spoil


def added(text):
    return lambda path: put(path, path.read_text() + text)


def flipped(position):
    def spoil(path):
        content = bytearray(path.read_bytes())
        content[position] ^= 1
        put(path, content)

    return spoil


def replaced(old, new):
    def spoil(path):
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return spoil


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("a pickle was executed",)


def pickled(path):
    put(path, pickle.dumps(Bomb()))


def torch_saved(path):
    torch.save({"obstacles": torch.zeros(2, 3), "policy": Bomb()}, path)


def tensors(change, header=lambda old: old):
    """Rewrite a safetensors file with other tensors, or another header."""

    def spoil(path):
        with safe_open(path, framework="pt") as file:
            kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            old = file.metadata()
        change(kept)
        save_file({name: value.contiguous() for name, value in kept.items()}, path, metadata=header(old))

    return spoil


def obstacles(change=lambda bank: bank, **header):
    def rewrite(kept):
        kept["obstacles"] = change(kept["obstacles"])

    return tensors(rewrite, lambda old: old | header)


def entry(row, column, value):
    def change(bank):
        bank[1, row, column] = value
        return bank

    return change


def consistent(path):
    """Another obstacle, and the checksum that belongs to it."""
    bank = entry(2, 2, 77.0)(layouts.load(path))
    layouts.save(bank, path, seed=0, split="train")


def facts(**changes):
    """Other facts in a policy's header; ... deletes one."""

    def header(old):
        inner = json.loads(old["uavnav"]) | changes
        return {"uavnav": json.dumps({key: value for key, value in inner.items() if value is not ...})}

    return tensors(lambda kept: None, header)


def header(content):
    return tensors(lambda kept: None, lambda old: None if content is None else {"uavnav": content})


def tensor(name, change):
    def rewrite(kept):
        value = change(kept.pop(name))
        if value is not None:
            kept[name] = value

    return tensors(rewrite)


def widened(value):
    return torch.cat([value, value[:, :1]], 1)


def to_nan(value):
    value[0, 0, 0] = math.nan
    return value


def meta(**changes):
    def spoil(path):
        content = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in content.items() if value is not ...}))

    return spoil


def table(change):
    def spoil(path):
        change(pd.read_parquet(path)).to_parquet(path, index=False)

    return spoil


def in_use(path):
    path.mkdir(exist_ok=True)
    return FileLock(path / ".lock")


def read_only(path):
    """As `chmod a-w` does for all but root."""
    return mock.patch.object(os, "access", return_value=False)


def newer_torch(path):
    facts = recorder._facts()
    facts["versions"]["torch"] = "9.9.9"
    return mock.patch.object(recorder, "_facts", return_value=facts)


def reseeded(path):
    replaced("\nseed: 0\n", "\nseed: 7\n")(path.parent / "config.yaml")


def replay_gone(path):
    for chunk in path.glob("replay-*"):
        chunk.unlink()


def status(word):
    return lambda path: meta(status=word)(path / "meta.json")


def snapshots(spoil):
    def each(path):
        found = sorted(path.glob("state-*"))
        assert found
        for state in found:
            spoil(state)

    return each


# -- calls -----------------------------------------------------------------------------------------------------------


def words(settings):
    return [f"{key}={value}".replace(" ", "") for key, value in settings.items()]


EVALUATE = ["evaluate", "{}/run", "--episodes", "2", "--max-steps", "5"]
VERIFY = ["verify", "{}/run"]
RENDER = ["render", "{}/policy", "--out", "{}/flight.png", "--steps", "2"]
NEW_BANK = ["layouts", "--out", "{}/new"]
AGAIN = ["ppo", *words(PPO), "out={}/run"]


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


# -- rows ------------------------------------------------------------------------------------------------------------


def bank(name, spoil, wrong, right="make one with python -m uavnav.layouts", part="bank"):
    check = ["layouts", "--check", "{}/" + part]
    return Case(f"bank: {name}", part, spoil, lambda f: layouts.check(f / part), LayoutError, wrong, right, check)


def bank_for(name, call, wrong, right, command=(), spoil=nothing):
    return Case(f"bank: {name}", "bank", spoil, call, LayoutError, wrong, right, list(command))


def policy(name, spoil, wrong="not a readable policy file", right="of a finished run", part="policy", seed=None):
    command = [word.replace("/policy", "/" + part) for word in RENDER] + (["--seed", str(seed)] if seed else [])
    load = lambda f: uavnav.load_policy(f / part, seed)  # noqa: E731
    return Case(f"policy: {name}", part, spoil, load, PolicyError, "{}/" + part + ": " + wrong, right, command)


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
    command = [algorithm, *words({key: "null" if value is None else value})]
    build = lambda f: kind.from_mapping(settings)  # noqa: E731
    wrong = f"{key}={value}; " if wrong is None else wrong
    return Case(f"config: {algorithm} {key}={value!r}", "thesis", nothing, build, ConfigError, wrong, right, command)


def word(name, wrong, right, *command):
    """Wrong on the command line alone."""
    return Case(f"word: {name}", "thesis", nothing, None, SystemExit, wrong, right, list(command))


def argument(name, call, wrong, right, *command):
    return Case(f"argument: {name}", "thesis", nothing, call, ValueError, wrong, right, list(command))


GOOD_BANK, READABLE = "make one with python -m uavnav.layouts", "{}/bank: not a readable bank"
SHAPE, ANEW, FOLDER = "a bank has the shape [n > 0, k, 3]", "generate it anew", "that can be written"
WHOLE, NUMBER, FILE, OVERWRITE = "give a whole number", "give a number", "or a file's path", "overwrite=true"
HEADER, RUN = "its tensors do not fit its header", "give a run's folder"
DAMAGED, NO_RUN, EMPTY = "missing or damaged", "its config.yaml is not a run's", "give a new or empty folder"
EXECUTED = "mkdir executed"
LONG = "x" * 300  # more than a file's name may have

CASES = [
    # a bank that is read
    bank("missing", missing, "{}/bank", FILE),
    bank("a folder", a_folder, "{}/bank", FILE),
    bank("below a file", nothing, "{}/policy/bank", FILE, part="policy/bank"),
    bank("a link to itself", itself, "{}/bank", FILE),
    bank("empty", written(b""), READABLE),
    bank("cut in the data", cut(0.9), READABLE),
    bank("cut in the header", cut(0.05), READABLE),
    bank("five bytes", written(b"\x08\0\0\0\0"), READABLE),
    bank("a header of 2^60 bytes", written(b"\0" * 7 + b"\x10" + b"x" * 90), READABLE),
    bank("longer than it says", lambda path: put(path, path.read_bytes() + b"more"), READABLE),
    bank("a table of text", written("x,y,radius\n1,2,30\n" * 9), READABLE),
    bank("a pickle", pickled, READABLE),
    bank("a file of torch.save", torch_saved, READABLE),
    bank("a flipped bit in the header", flipped(8), READABLE),
    bank("a flipped bit in the data", flipped(-4), "{}/bank: the checksum does not match", ANEW),
    bank("no header", header(None), "{}/bank: made for world version None", ANEW),
    bank("another world version", obstacles(world_version="0"), "version 0, this is 1", ANEW),
    bank("no checksum", obstacles(sha256=""), "{}/bank: the checksum does not match", ANEW),
    bank("another n in the header", obstacles(n="21"), "{}/bank: its header says n=21, k=4,", "not n=20, k=4"),
    bank("no k in the header", obstacles(k=""), "{}/bank: its header says n=20, k=,", "not n=20, k=4"),
    bank("other tensors", tensors(lambda kept: kept.update(a=kept.pop("obstacles"))), "no tensor `obstacles`"),
    bank("float64", obstacles(lambda b: b.double()), "not float64", "{}/bank: a bank holds float32"),
    bank("whole numbers", obstacles(lambda b: b.long()), "not int64", "{}/bank: a bank holds float32"),
    bank("two axes", obstacles(lambda b: b[0]), "not [4, 3]", SHAPE),
    bank("two columns", obstacles(lambda b: b[..., :2]), "not [20, 4, 2]", SHAPE),
    bank("no sets", obstacles(lambda b: b[:0]), "not [0, 4, 3]", SHAPE),
    bank("nan", obstacles(entry(2, 0, math.nan)), "{}/bank: obstacle 2 of set 1 is not finite", ANEW),
    bank("an infinite radius", obstacles(entry(0, 2, math.inf)), "obstacle 0 of set 1 is not finite", ANEW),
    bank("a radius of 29.9", obstacles(entry(3, 2, 29.9)), "obstacle 3 of set 1 has a radius", "30 ... 100 px"),
    bank("a radius of 101", obstacles(entry(3, 2, 101.0)), "obstacle 3 of set 1 has a radius", "30 ... 100 px"),
    bank("on the start", obstacles(entry(0, slice(2), 400.0)), "obstacle 0 of set 1", "nearer than 50 px to the start"),
    bank("doctored with its checksum", consistent, "{}/bank: is not what seed 0 generates", ANEW),
    bank("a seed in words", obstacles(generator_seed="seven"), "{}/bank: is not what seed seven generates", ANEW),
    bank_for(
        "a run",
        lambda f: train_ppo(f, "new", layouts=str(f / "bank")),
        READABLE,
        GOOD_BANK,
        ["ppo", "layouts={}/bank", "out={}/new"],
        cut(0.9),
    ),
    bank_for("an environment", lambda f: uavnav.DroneEnv([2], f / "bank"), "checksum", ANEW, spoil=flipped(-4)),
    bank_for("Gymnasium", lambda f: gymnasium.make(DRONE, layouts=f / "bank"), READABLE, GOOD_BANK, spoil=cut(0)),
    bank_for("an evaluation", lambda f: evaluate(f, layouts="tset"), "'tset'", FILE, [*EVALUATE, "--layouts", "tset"]),
    bank_for("a baseline", lambda f: fly(f, layouts="x" * 300), "xxx", FILE, ["evaluate", "random", "--layouts", LONG]),
    bank_for("a picture", lambda f: layouts.load("tset"), "'tset'", FILE, [*RENDER, "--layouts", "tset"]),
    # a bank that is made
    bank_for("-1 sets", lambda f: layouts.generate(-1), "n=-1", "at least 0", [*NEW_BANK, "--n", "-1"]),
    bank_for("-1 obstacles", lambda f: layouts.generate(1, -1), "k=-1", "at least 0", [*NEW_BANK, "--k", "-1"]),
    bank_for(
        "seed -1",
        lambda f: layouts.generate(1, 1, -1),
        "seed=-1",
        "at least 0",
        [*NEW_BANK, "--seed=-1", "--split=test"],
    ),
    bank_for("no set", lambda f: save_bank(f / "new", 0), "not [0, 8, 3]", "n > 0", [*NEW_BANK, "--n", "0"]),
    bank_for(
        "a folder below a file",
        lambda f: save_bank(f / "policy" / "x"),
        "{}/policy/",
        FOLDER,
        ["layouts", "--out={}/policy", "--n=1"],
    ),
    bank_for(
        "in /proc", lambda f: save_bank("/proc/no/x"), "/proc/no/", FOLDER, ["layouts", "--out=/proc/no", "--n=1"]
    ),
    bank_for("onto a folder", lambda f: save_bank(f / "thesis"), "{}/thesis: cannot be written", FOLDER),
    word("one seed for both banks", "--seed 3", "give --split", *NEW_BANK, "--seed", "3"),
    # a policy
    policy("missing", missing, "no policy.safetensors there", "give the folder of a finished run"),
    policy("of a folder without", nothing, "no policy.safetensors there", "give the folder", part="thesis"),
    policy("of a half-finished run", nothing, "no policy.safetensors there", "give the folder", part="half"),
    policy("empty", written(b"")),
    policy("cut in the data", cut(0.9)),
    policy("cut in the header", cut(0.02)),
    policy("a pickle", pickled),
    policy("a file of torch.save", torch_saved),
    policy("a bank", lambda path: put(path, path.with_name("bank").read_bytes())),
    policy("no header", header(None)),
    policy("a header that is not JSON", header("{")),
    policy("a header that is a list", header("[1]")),
    policy("no seeds in the header", facts(seeds=...)),
    policy("seeds a number", facts(seeds=4)),
    policy("seeds words", facts(seeds="01")),
    policy("no seed", facts(seeds=[]), "holds no seed"),
    policy("a seed too many", facts(seeds=[0, 1, 2]), HEADER),
    policy("hidden a number", facts(hidden=8)),
    policy("hidden words", facts(hidden="8"), HEADER),
    policy("hidden a fraction", facts(hidden=[8.5]), HEADER),
    policy("hidden negative", facts(hidden=[-8]), HEADER),
    policy("another hidden", facts(hidden=[9]), HEADER),
    policy("too many layers", facts(hidden=[8, 8]), HEADER),
    policy("activation a list", facts(activation=["relu"]), "unknown activation ['relu']", "choose from elu, gelu"),
    policy("an unknown activation", facts(activation="rleu"), "unknown activation 'rleu'", "choose from elu, gelu"),
    policy("an unknown algorithm", facts(algorithm="sac"), "unknown algorithm 'sac'", "choose from dqn, ppo"),
    policy("an unknown reward", facts(reward="eq15"), "unknown reward 'eq15'", "choose from additive, eq14, initial"),
    policy("epsilon a word", facts(epsilon="small")),
    policy("an unknown switch", facts(world={"gravity": 9.81})),
    policy("a wrong switch", facts(world={"slots": "first"}), "not a readable policy file (slots='first'"),
    policy("another world version", facts(world_version="0"), "trained in world version 0", "this is 1"),
    policy("a tensor missing", tensor("policy.0.bias", lambda t: None), HEADER),
    policy("a tensor cut", tensor("policy.2.weight", lambda t: t[:, :7]), HEADER),
    policy("a tensor flat", tensor("policy.0.weight", torch.flatten), HEADER),
    policy("31 inputs", tensor("policy.0.weight", widened), "sees 31 numbers", "not 30 and 100"),
    policy("nan", tensor("policy.2.weight", to_nan), "policy.2.weight of seed 0 is not finite", "lower lr"),
    policy("another seed", nothing, "seed=7 is not there", "choose from 0 ... 1", seed=7),
    # a run
    run("", "missing", missing, "no such run folder", RUN),
    run("", "a file", a_file, "no such run folder", RUN),
    Case("run: too long a name", "run", nothing, lambda f: Run(LONG), RunError, LONG, RUN, ["evaluate", LONG]),
    run("config.yaml", "missing", missing, DAMAGED, RUN),
    run("config.yaml", "empty", written(""), "not a run's configuration", RUN),
    run("config.yaml", "a list", written("[1, 2]"), "not a run's configuration", RUN),
    run("config.yaml", "a word", written("tanh"), "not a run's configuration", RUN),
    run("config.yaml", "a syntax error", written("[1"), DAMAGED, RUN),
    run("config.yaml", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("config.yaml", "a date that is none", written("seed: 2001-13-45"), DAMAGED, RUN),
    run("config.yaml", "a thousand brackets", written("[" * 1000), DAMAGED, RUN),
    run("config.yaml", "a command", written(f"!!python/object/apply:os.system ['{EXECUTED}']"), DAMAGED, RUN),
    run(
        "config.yaml", "a command below", written(f"seed: !!python/object/apply:os.system ['{EXECUTED}']"), DAMAGED, RUN
    ),
    run("config.yaml", "no algorithm", replaced("algorithm: ppo\n", ""), "not a run's, its algorithm=None", RUN),
    run("config.yaml", "no seed", replaced("\nseed: 0\n", "\n"), "not a run's, its seed=None", RUN),
    run("config.yaml", "a seed in words", replaced("\nseed: 0\n", "\nseed: zero\n"), "not a run's, its seed=zero", RUN),
    run("config.yaml", "no seeds", replaced("n_seeds: 2", "n_seeds: 0"), "not a run's, its n_seeds=0", RUN),
    run("config.yaml", "no more than half", cut(0.5), "", RUN),
    run(
        "config.yaml", "another algorithm", replaced(": ppo", ": sac"), "algorithm=sac; ", "choose from", verify, VERIFY
    ),
    run(
        "config.yaml",
        "dqn's keys",
        replaced(": ppo", ": dqn"),
        "there is no key 'frames_per_batch'",
        "choose from",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "an unknown key",
        added("speed: 3\n"),
        "there is no key 'speed'",
        "choose",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "a key that is a number",
        added("3: 3\n"),
        "there is no key 3",
        "choose",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "a wrong value",
        replaced("gamma: 0.99", "gamma: 9"),
        "gamma=9",
        NUMBER,
        verify,
        VERIFY,
        ConfigError,
    ),
    Case(
        "run/config.yaml: a bank that is gone",
        "run/config.yaml",
        replaced("layouts: train", "layouts: tset"),
        verify,
        LayoutError,
        "layouts='tset': no such bank",
        FILE,
        VERIFY,
    ),
    run("meta.json", "missing", missing, DAMAGED, RUN),
    run("meta.json", "empty", written(""), DAMAGED, RUN),
    run("meta.json", "cut", cut(0.5), DAMAGED, RUN),
    run("meta.json", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("meta.json", "many brackets", written("[" * 100_000), DAMAGED, RUN),
    run("meta.json", "a list", written("[1]"), "not a run's facts", RUN),
    run("meta.json", "no frames", meta(frames=...), "not a run's, its frames=None", RUN),
    run("meta.json", "frames in words", meta(frames="many"), "not a run's, its frames=many", RUN),
    run("", "under way", status("running"), "the run is not finished", "give the same command again"),
    *(
        run(f"{name}.parquet", how, spoil, wrong, OVERWRITE)
        for name in ("episodes", "progress")
        for how, spoil, wrong in (
            ("missing", missing, DAMAGED),
            ("a folder", a_folder, DAMAGED),
            ("empty", written(b""), DAMAGED),
            ("cut", cut(0.7), DAMAGED),
            ("text", written("seed,frame\n0,1\n"), DAMAGED),
            ("a pickle", pickled, DAMAGED),
            ("other columns", table(lambda t: t.rename(columns={"frame": "time"})), "its columns are not"),
            ("words for numbers", table(lambda t: t.astype({"seed": str})), "its columns are not"),
        )
    ),
    Case(
        "run/policy.safetensors: missing",
        "run/policy.safetensors",
        missing,
        evaluate,
        PolicyError,
        "{}/run: no policy.safetensors there",
        "give the folder of a finished run",
        EVALUATE,
    ),
    run(
        "policy.safetensors",
        "cut",
        cut(0.5),
        "not a readable policy",
        "of a finished run",
        evaluate,
        EVALUATE,
        PolicyError,
    ),
    run("policy.safetensors", "cut before a repeat", cut(0.5), DAMAGED, OVERWRITE, verify, VERIFY),
    *(
        run("evaluation.parquet", how, spoil, wrong, "evaluate the run again", read_evaluation, AGAIN)
        for how, spoil, wrong in (
            ("cut", cut(0.7), DAMAGED),
            ("no modes", table(lambda t: t.drop(columns="mode")), "its columns are not"),
            ("rewards in words", table(lambda t: t.astype({"reward": str})), "its columns are not"),
        )
    ),
    # where a run is to go
    out("a file", "run", a_file, "out={}/run: is a file", "give a folder"),
    out("below a file", "thesis", nothing, "{}/policy is not", FOLDER, target="policy/run"),
    out("in /proc", "thesis", nothing, "out=/proc/nowhere/run: ", FOLDER, target="/proc/nowhere/run"),
    out("too long a name", "thesis", nothing, "xxx: cannot be written", FOLDER, target=LONG),
    out("in a folder that is read-only", "thesis", read_only, "{} is not", FOLDER, target="new"),
    out(
        "among other files",
        "thesis",
        nothing,
        "out={}/thesis: holds other files",
        "give a new or empty",
        target="thesis",
    ),
    out("over other files", "thesis", nothing, "holds other files", "give a new or empty", "thesis", overwrite=True),
    out("over another program's", "thesis/config.yaml", written("kind: Pod"), NO_RUN, EMPTY, "thesis", overwrite=True),
    out("over another's run", "thesis/config.yaml", written("algorithm: sac"), NO_RUN, EMPTY, "thesis", overwrite=True),
    out(
        "over a damaged config", "run/config.yaml", written("[1"), "{}/run/config.yaml: " + DAMAGED, "", overwrite=True
    ),
    out("a config of keys that are numbers", "run/config.yaml", added("1: 2\n"), "with 1=2, not None", OVERWRITE),
    out("another learning rate", "run", nothing, "holds a run with lr=0.0003, not 0.1", OVERWRITE, lr=0.1),
    out("another network", "run", nothing, "holds a run with hidden=[8], not [9]", OVERWRITE, hidden=[9]),
    out("another algorithm's", "run/config.yaml", replaced(": ppo", ": dqn"), "algorithm=dqn, not ppo", OVERWRITE),
    out("finished, a table gone", "run/episodes.parquet", missing, "{}/run/episodes.parquet: missing", OVERWRITE),
    out("finished, the policy gone", "run/policy.safetensors", missing, "{}/run/policy.safetensors: ", OVERWRITE),
    out("facts cut", "run/meta.json", cut(0.5), "{}/run/meta.json: " + DAMAGED, RUN),
    out("in use", "new", in_use, "another process is writing this run", "wait for it", target="new"),
    out("in use, to be overwritten", "run", in_use, "another process is writing", "wait for it", overwrite=True),
    out("a folder for a lock", "run/.lock", Path.mkdir, "out={}/run: cannot be written", FOLDER, overwrite=True),
    Case(
        "out: another bank than before",
        "run/meta.json",
        meta(bank={"sha256": "0" * 64}),
        train_ppo,
        RunError,
        "the bank layouts=train has changed",
        OVERWRITE,
        ["ppo", *words(PPO), "out={}/run"],
    ),
    # a run that was interrupted
    half("every snapshot cut", snapshots(cut(0.9)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot flipped", snapshots(flipped(-4)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot empty", snapshots(written(b"")), "damaged, its checksum does not match", OVERWRITE),
    half("its replay gone", replay_gone, "missing or not readable", OVERWRITE),
    half("of another version of torch", newer_torch, "saved with version of torch=", OVERWRITE),
    half("another seed", nothing, "holds a run with seed=0, not 7", OVERWRITE, seed=7),
    half("another seed everywhere", reseeded, "saved with seed=0, not 7", OVERWRITE, seed=7),
    Case(
        "half: read",
        "half",
        nothing,
        lambda f: Run(f / "half"),
        RunError,
        "{}/half: the run is not finished",
        "same command",
        ["verify", "{}/half"],
    ),
    # a configuration
    config({"activatoin": "relu"}, "did you mean activation?", "there is no key 'activatoin'"),
    config({"batch_size": 3}, "choose from", "there is no key 'batch_size'"),
    config({"epochs": 3}, "choose from", "there is no key 'epochs'", "dqn"),
    config({"preset": "papr"}, "did you mean paper?"),
    config({"activation": "rleu"}, "choose from elu, gelu"),
    config({"activation": 3}, "give a name"),
    config({"activation": None}, "give a name"),
    config({"layouts": 3}, "give a name"),
    config({"reward": "eq15"}, "choose from additive, eq14, initial"),
    config({"slots": "first"}, "choose from listed, nearest"),
    config({"padding": "ones"}, "choose from far, zeros"),
    config({"start_heading": "down"}, "choose from random, up"),
    config({"init": "xavier"}, "choose from default, orthogonal"),
    config({"compile": "maybe"}, "choose from auto, off, on"),
    config({"loss": "l1"}, "choose from huber, squared", algorithm="dqn"),
    config({"device": "gpu"}, "choose cpu"),
    config({"device": "meta"}, "choose cpu"),
    config({"device": "cuda:99"}, "choose cpu"),
    config({"n_seeds": 0}, "at least 1"),
    config({"n_seeds": "two"}, WHOLE),
    config({"n_seeds": True}, WHOLE),
    config({"n_seeds": None}, WHOLE),
    config({"seed": -1}, "at least 0"),
    config({"seed": 1.5}, WHOLE),
    config({"seed": 2**31}, "at most 2147483647"),
    config({"total_frames": 0}, "at least 1"),
    config({"total_frames": 0.5}, WHOLE),
    config({"total_frames": math.inf}, WHOLE),
    config({"total_frames": math.nan}, WHOLE),
    config({"max_steps": 0}, "at least 1"),
    config({"max_steps": "never"}, WHOLE),
    config({"lr": -1.0}, "at least 0"),
    config({"lr": "fast"}, NUMBER),
    config({"lr": True}, NUMBER),
    config({"lr": math.nan}, NUMBER),
    config({"lr": math.inf}, NUMBER),
    config({"gamma": 1.1}, "at most 1"),
    config({"epsilon_end": 2.0}, "at most 1", algorithm="dqn"),
    config({"hidden": 64}, "such as [64,64]"),
    config({"hidden": []}, "at least one layer"),
    config({"hidden": [64, 0]}, "at least 1 unit"),
    config({"hidden": [64, "x"]}, WHOLE, "hidden=x; "),
    config({"hidden": [8.5]}, WHOLE, "hidden=8.5; "),
    config({"n_worlds": 7}, "give a divisor of frames_per_batch=2048"),
    config({"n_worlds": 6}, "give a multiple or a divisor of frames_per_update=4", algorithm="dqn"),
    config({"minibatch_size": 100}, "give a divisor of frames_per_batch=2048"),
    config({"minibatch_size": 1}, "at least 2"),
    config({"buffer_size": 8}, "give more than n_worlds=64", algorithm="dqn"),
    word("overwrite", "overwrite=2; ", "choose from false, true", "ppo", "overwrite=2"),
    word("evaluate", "evaluate=maybe; ", "choose from false, true", "dqn", "evaluate=maybe"),
    word("checkpoint_seconds", "checkpoint_seconds=-1; ", "at least 0", "ppo", "checkpoint_seconds=-1"),
    word("a key without a value", "'relu'", "", "ppo", "relu"),
    word("a sweep with one wrong", "activation=rleu; ", "did you mean relu?", "ppo", "-m", "activation=relu,rleu"),
    word(
        "a sweep into one folder", "out=new: two runs of the sweep", "leave it out", "ppo", "-m", "seed=1,2", "out=new"
    ),
    # arguments
    argument(
        "0 episodes", lambda f: fly(f, episodes=0), "episodes=0", "1 to 1000", "evaluate", "random", "--episodes=0"
    ),
    argument(
        "1001 episodes", lambda f: fly(f, episodes=1001), "=1001", "1 to 1000", "evaluate", "random", "--episodes=1001"
    ),
    argument(
        "0 steps", lambda f: fly(f, max_steps=0), "max_steps=0", "at least 1", "evaluate", "random", "--max-steps=0"
    ),
    argument("a reward", lambda f: fly(f, reward="eq15"), "reward='eq15'", "choose from eq14"),
    argument("a slot order", lambda f: uavnav.World(slots="first"), "slots='first'", "choose from nearest, listed"),
    argument("a border", lambda f: uavnav.World(border=30), "border=30", "must divide"),
    argument("an activation", lambda f: uavnav.networks.Activation("rleu"), "activation='rleu'", "choose from elu"),
    argument("a cap", lambda f: uavnav.DroneEnv(max_steps=0), "max_steps=0", "a whole number from 1"),
    argument("a cap in half steps", lambda f: uavnav.DroneEnv(max_steps=1.5), "max_steps=1.5", "a whole number from 1"),
    argument("seeds", lambda f: uavnav.DroneEnv([3], seeds=[1, 2]), "2 seeds for batch_size [3]", "one per agent"),
    argument("a drone's action", lambda f: gym_env().step(100), "action=100", "from 0 to 99"),
    argument("a drone's layout", lambda f: gym_env(layout=1000), "layout=1000", "from 0 to 999"),
    argument("no drone", lambda f: uavnav.gym.DroneVectorEnv(0), "num_envs=0", "at least 1"),
    argument("a screen", lambda f: uavnav.gym.DroneGymEnv(render_mode="human"), "'human'", "choose None or rgb_array"),
    argument(
        "a picture's kind", lambda f: save_picture(f / "x.bmp"), "x.bmp", ".gif or .png", *RENDER, "--out", "x.bmp"
    ),
    argument(
        "a picture's folder",
        lambda f: save_picture(f / "no/x.png"),
        "no/x.png",
        "a path that can be written",
        *RENDER,
        "--out",
        "{}/no/x.png",
    ),
    word("a picture's set", "--layout 1000", "choose from 0 to 999", *RENDER, "--layout", "1000"),
    word("a picture's steps", "--steps", "at least 1", *RENDER, "--steps", "0"),
    word("a repeat's frames", "--frames 0", "at least 1", *VERIFY, "--frames", "0"),
]


def said(case, folder, text):
    """One line with both fragments."""
    assert "\n" not in text
    for fragment in (case.wrong, case.right):
        assert fragment.replace("{}", str(folder)) in text, text


@pytest.fixture
def folder(good, tmp_path, monkeypatch):
    """A copy of the good folder to spoil, and the current directory."""
    monkeypatch.chdir(shutil.copytree(good, tmp_path / "here"))
    return tmp_path / "here"


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


def test_there_are_more_than_60_cases_in_the_library_and_on_the_command_line_and_no_two_of_one_name():
    assert len({case.name for case in CASES}) == len(CASES)
    assert sum(case.call is not None for case in CASES) > 200
    assert sum(bool(case.command) for case in CASES) > 200


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.call))
def test_in_the_library_it_is_one_line_of_a_typed_exception_and_nothing_changes(case, folder):
    with spoilt(case, folder), pytest.raises(case.error) as refused:
        case.call(folder)
    assert type(refused.value) is case.error
    said(case, folder, str(refused.value))


MAINS = {"layouts": layouts.main, "evaluate": evaluation.main, "verify": verification.main, "render": rendering.main}


def launch(algorithm, arguments, monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES))
    from launch import launch as launch_recipe

    module = {"ppo": ppo, "dqn": dqn}[algorithm]
    monkeypatch.setattr(sys, "argv", [f"recipes/{algorithm}.py", *arguments])
    launch_recipe(module.ALGORITHM, module.PRESETS, module.train)


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.command))
def test_on_the_command_line_it_is_one_line_a_status_and_nothing_changes(case, folder, monkeypatch, capfd):
    program, *arguments = [word.replace("{}", str(folder)) for word in case.command]
    with spoilt(case, folder):
        try:
            status = MAINS[program](arguments) if program in MAINS else launch(program, arguments, monkeypatch)
        except SystemExit as stop:
            status = stop.code
    printed, complained = capfd.readouterr()
    if isinstance(status, str):  # sys.exit(line) prints it and ends with 1
        status, complained = 1, complained + status + "\n"
    assert status in (1, 2)
    assert printed == ""
    assert complained.startswith((f"uavnav.{program}: ", f"{program}: "))
    assert complained.endswith("\n")
    said(case, folder, complained[:-1])


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["-m", "uavnav.layouts", "--check", "{}/thesis"], "uavnav.layouts: layouts='{}/thesis': no such bank; "),
        (["-m", "uavnav.evaluate", "{}/thesis"], "uavnav.evaluate: {}/thesis/config.yaml: missing or damaged; "),
        ([RECIPES / "dqn.py", "out={}/policy"], "dqn: out={}/policy: is a file; give a folder"),
    ],
)
def test_as_a_process_it_is_one_line_too(folder, command, message):
    before = tree(folder)
    words = [str(word).replace("{}", str(folder)) for word in command]
    result = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert result.returncode in (1, 2)
    assert result.stdout == ""
    assert result.stderr.startswith(message.replace("{}", str(folder)))
    assert result.stderr.count("\n") == 1
    assert tree(folder) == before


# -- a full disk -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def full(name, forever):
    """The disk is full when a file of this name is half-written; and stays so, or only that file is refused."""
    write, out_of_space = Path.write_bytes, []

    def write_half(path, content):
        if path.name.strip(".").startswith(name) or (forever and out_of_space):
            out_of_space.append(path)
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, content)

    with mock.patch.object(Path, "write_bytes", write_half):
        yield
    assert out_of_space


@pytest.mark.parametrize("forever", [False, True])
@pytest.mark.parametrize("name", ["config.yaml", "meta.json", "state-", "replay-", *runs.FILES[2:]])
def test_a_run_whose_disk_is_full_says_so_in_one_line_and_goes_on_when_there_is_space(tmp_path, name, forever):
    def train(folder):
        return dqn.train(dqn.DQNConfig(**DQN), folder, quiet=True, checkpoint_seconds=0)

    with full(name, forever), pytest.raises(RunError) as refused:
        train(tmp_path / "run")
    message = str(refused.value)
    assert "\n" not in message
    assert name.strip("-") in message or "checkpoint" in message
    assert "No space left on device" in message
    left = {str(path.relative_to(tmp_path / "run")) for path in tmp_path.glob("run/**/*") if path.is_file()}
    assert {path for path in left if not path.startswith("checkpoint/")} <= set(runs.FILES)
    assert not any(path.startswith("checkpoint/.") for path in left)
    again, whole = train(tmp_path / "run"), train(tmp_path / "whole")
    for part in ("episodes.parquet", POLICY):
        assert (again.path / part).read_bytes() == (whole.path / part).read_bytes()


@pytest.mark.parametrize("name", ["evaluation.parquet", "behaviour.parquet"])
def test_an_evaluation_whose_disk_is_full_leaves_the_old_rows(folder, name):
    before = tree(folder)
    with full(name, True), pytest.raises(RunError, match=rf"{name}: cannot be written .*No space left") as refused:
        evaluate(folder, episodes=3)
    assert "\n" not in str(refused.value)
    after = tree(folder)
    assert after.keys() == before.keys()
    assert after[f"run/{name}"] == before[f"run/{name}"]
    assert len(evaluate(folder, episodes=3)) == 2 * 2 * 3


def test_a_bank_or_a_picture_whose_disk_is_full_is_the_old_one(folder):
    save_picture(folder / "flight.gif")
    before = tree(folder)
    with full("bank", True), pytest.raises(LayoutError, match=r"bank: cannot be written .*No space left"):
        save_bank(folder / "bank")
    with full("flight", True), pytest.raises(ValueError, match=r"flight.gif: cannot be written .*No space left"):
        save_picture(folder / "flight.gif")
    assert tree(folder) == before
