"""Bad input gets one line that names what is wrong and what would be right, a typed exception in the library,
a non-zero status on the command line, and nothing half-written.

One table of cases: how each spoils a part of a good folder, what is called then, and what must be answered.
Other tests spoil their files in the same ways.
"""

import functools
import itertools
import json
import math
import os
import pickle
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from filelock import FileLock
from policies_by_hand import write_zip
from safetensors import safe_open
from safetensors.torch import load, save, save_file

import uavnav
from uavnav import ConfigError, LayoutError, PolicyError, RunError, evaluation
from uavnav.algorithms import ALGORITHMS, dqn, ppo
from uavnav.evaluation import verify as verification
from uavnav.runs import POLICY, Run
from uavnav.runs.policies import Diverged
from uavnav.tasks import layouts, moving
from uavnav.tasks.faults import Faults
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.table import make_task
from uavnav.training import checkpoints, provenance
from uavnav.training.recorder import Interrupted, OtherRun
from uavnav.views import render as rendering

# -- ways to spoil a file or a folder, each a function of its path -------------------------------------------


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


def a_pipe(path):
    """Which nobody writes into: whoever opens it as a file waits."""
    missing(path)
    os.mkfifo(path)


def endless(path):
    missing(path)
    path.symlink_to("/dev/full")  # which reads as zeros


def large(path):
    """A file without end for whoever reads all of it, which takes no room."""
    os.truncate(path, 2**40)


YAML_BOMB = "a: &a [x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in itertools.pairwise("abcdefghijkl")
)
"""Some hundred bytes for 2 * 9^11 words."""


@functools.cache
def much_in_little():
    """A table of 10^7 rows in each of 50 columns, in some kilobytes."""
    nulls, content = pa.nulls(10**7), pa.BufferOutputStream()
    pq.write_table(pa.table({f"column {index}": nulls for index in range(50)}), content)
    assert content.tell() < 2**20
    return content.getvalue().to_pybytes()


def unfolding(path):
    put(path, much_in_little())


def columns(**content):
    """A table with other columns, each of one row."""
    return lambda path: pq.write_table(pa.table({name: [value] for name, value in content.items()}), path)


def lying(**entry):
    """A safetensors header that says something else of its first tensor, or of its whole."""

    def spoil(path):
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        first = next(name for name in header if name != "__metadata__")
        text = json.dumps(header | {first: header[first] | entry}).encode()
        put(path, len(text).to_bytes(8, "little") + text + content[8 + size :])

    return spoil


def headed(text):
    """A safetensors file of nothing but a header."""
    return lambda path: put(path, len(text).to_bytes(8, "little") + text.encode())


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


def cut_before(word):
    """Cut where a word begins."""
    return lambda path: put(path, path.read_text().partition(word)[0])


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


def obstacles(change=lambda all_layouts: all_layouts, **header):
    def rewrite(kept):
        kept["obstacles"] = change(kept["obstacles"])

    return tensors(rewrite, lambda old: old | header)


def entry(row, column, value):
    def change(all_layouts):
        all_layouts[1, row, column] = value
        return all_layouts

    return change


def consistent(path):
    """Another obstacle, and the checksum that belongs to it."""
    all_layouts = entry(2, 2, 77.0)(layouts.load(path))
    layouts.save(all_layouts, path, seed=0, split="train")


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
    facts = provenance.facts()
    facts["versions"]["torch"] = "9.9.9"
    return mock.patch.object(provenance, "facts", return_value=facts)


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
        assert len(found) == 2
        for state in found:
            spoil(state)

    return each


def doctored(change):
    """A state with other tensors or another header, under the name that belongs to its bytes."""

    def spoil(path):
        content = path.read_bytes()
        found, header = load(content), json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        said = json.loads(header["__metadata__"]["uavnav"])
        said = change(found, said) or said
        content = save(found, {"uavnav": said if isinstance(said, str) else json.dumps(said)})
        path.unlink()
        stem = f"{path.name.rpartition('-')[0]}-{checkpoints._digest(content)}"
        path.with_name(f"{stem}.safetensors").write_bytes(content)

    return spoil


def state_facts(**changes):
    return lambda tensors, header: header | {"facts": header["facts"] | changes}


# -- how a case is written -----------------------------------------------------------------------------------

RECIPES = Path(__file__).parent.parent / "recipes"
PPO = {
    "n_envs": 16,
    "total_frames": 64,
    "frames_per_batch": 64,
    "minibatch_size": 32,
    "epochs": 1,
    "n_seeds": 2,
    "hidden": [8],
    "compile": "off",
}
DRONE = "uavnav/Drone-v0"
DQN = {"n_envs": 64, "total_frames": 256, "learning_starts": 32, "hidden": [8], "compile": "off"}


class Case(NamedTuple):
    """How to spoil a part of a good folder, what to call then, and what must be answered."""

    name: str
    part: str  # that is spoilt, below the folder
    spoil: Callable[[Path], Any]  # it; may return a context to stay in
    call: Callable[[Path], Any] | None  # on the folder; None where only the command line can be wrong
    error: type[Exception]
    wrong: str  # in the message
    right: str  # too
    command: str  # the same on the command line; empty where it has no such words


# -- the good folder -----------------------------------------------------------------------------------------


def make_good(folder):
    """A layout file, a finished and evaluated run, a half-finished one, a policy, a thesis: all as they
    should be.
    """
    layouts.save(layouts.generate(20, 4, seed=0), folder / "layouts", seed=0, split="train")
    run = ppo.train(ppo.PPOConfig(**PPO), out=folder / "run", quiet=True)
    evaluation.evaluate_run(run, episodes=2, max_steps=5)
    for path in run.path.glob("*-test-2-5.parquet"):  # stands for 200 layouts and 10,000 steps
        shutil.copy(path, path.with_name(f"{path.name.partition('-')[0]}.parquet"))
    for until in (64, 128):  # two snapshots
        with pytest.raises(Interrupted):
            dqn.train(dqn.DQNConfig(**DQN), out=folder / "half", quiet=True, until=until)
    shutil.copy(run.path / POLICY, folder / "policy")
    write_zip(folder / "theirs.zip")
    (folder / "thesis").mkdir()
    (folder / "thesis" / "chapter.txt").write_text("It was a dark and stormy night.")
    return folder


def tree(folder):
    """Every path below a folder, with its bytes."""
    return {str(path.relative_to(folder)): held(path) for path in folder.rglob("*")}


def held(path):
    """A file's bytes; of one that is too large to be read, how many; the mode of what is no file."""
    if not path.is_file():
        return path.lstat().st_mode
    size = path.stat().st_size
    return path.read_bytes() if size < 2**30 else size


def words(settings):
    return " ".join(shlex.quote(f"{key}={value}".replace(" ", "")) for key, value in settings.items())


EVALUATE = "evaluate {}/run --episodes 2 --max-steps 5"
VERIFY = "verify {}/run"
RENDER = "render {}/policy --out {}/episode.png --steps 2"
SHOWS = ("render", "play")
NEW_LAYOUTS = "layouts --out {}/new"
REPORT = "report {}/run"


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


def save_layouts(path, n=1):
    layouts.save(layouts.generate(n), path, seed=0, split="test")


def save_picture(path):
    rendering.save([np.zeros((600, 800, 3), dtype=np.uint8)], path, 30)


def gym_env(**options):
    env = uavnav.gym.DroneGymEnv(layouts="test")
    env.reset(options=options)
    return env


def gym_envs():
    envs = uavnav.gym.DroneVectorEnv(2)
    envs.reset(seed=0)
    return envs


def all_layouts(name, spoil, wrong, right="make one with uavnav layouts", part="layouts"):
    check = "layouts --check {}/" + part
    return Case(
        f"layouts: {name}", part, spoil, lambda f: layouts.check(f / part), LayoutError, wrong, right, check
    )


def layouts_for(name, call, wrong, right, command="", spoil=nothing):
    return Case(f"layouts: {name}", "layouts", spoil, call, LayoutError, wrong, right, command)


def policy(
    name,
    spoil,
    wrong="not a readable policy file",
    right="of a finished run",
    part="policy",
    seed=None,
    error=PolicyError,
):
    command = RENDER.replace("/policy", "/" + part) + (f" --seed {seed}" if seed else "")
    load = lambda f: uavnav.load_policy(f / part, seed)  # noqa: E731
    return Case(f"policy: {name}", part, spoil, load, error, "{}/" + part + ": " + wrong, right, command)


READS, VERIFIES = (read, EVALUATE), (verify, VERIFY)
EVALUATES, REPORTS = (evaluate, EVALUATE), (read_evaluation, REPORT)


def run(part, name, spoil, wrong, right, by=READS, error=RunError):
    """A run of which a part is spoilt, told by a call and its command."""
    part = f"run/{part}".rstrip("/")
    return Case(f"{part}: {name}", part, spoil, by[0], error, "{}/" + part + ": " + wrong, right, by[1])


OTHER = {"error": OtherRun}
"""Of a folder that holds another run."""


def out(name, part, spoil, wrong, right, target="run", overwrite=False, error=RunError, **settings):
    place = target if target[0] == "/" else "{}/" + target
    command = "ppo " + words(PPO | settings | {"out": place, "overwrite": str(overwrite).lower()})
    call = lambda f: train_ppo(f, target, overwrite, **settings)  # noqa: E731
    return Case(f"out: {name}", part, spoil, call, error, wrong, right, command)


def half(name, spoil, wrong, right, error=RunError, **settings):
    part, command = "half/checkpoint", f"dqn {words(DQN | settings)} out={{}}/half"
    return Case(
        f"half: {name}", part, spoil, lambda f: train_dqn(f, **settings), error, wrong, right, command
    )


def config(settings, right, wrong=None, algorithm="ppo"):
    kind = ALGORITHMS[algorithm].config
    [(key, value)] = settings.items()
    if key in ("world", "faults") and isinstance(value, dict):
        [(field, value)] = value.items()
        key = f"{key}.{field}"
    command = f"{algorithm} {words({key: 'null' if value is None else value})}"
    build = lambda f: kind.from_mapping(settings)  # noqa: E731
    wrong = f"{key}={value}; " if wrong is None else wrong
    return Case(
        f"config: {algorithm} {key}={value!r}", "thesis", nothing, build, ConfigError, wrong, right, command
    )


def word(command, wrong, right):
    """Wrong on the command line alone."""
    return Case(f"word: {command[:80]}", "thesis", nothing, None, SystemExit, wrong, right, command)


def argument(name, call, wrong, right, command="", error=ValueError):
    return Case(f"argument: {name}", "thesis", nothing, call, error, wrong, right, command)


def misused(name, call, wrong, right):
    """An argument that is a setting, wrong in the library alone."""
    return argument(name, call, wrong, right, error=ConfigError)


def of_task(name, wrong, right, error=ConfigError, **parts):
    """A part of a task, wrong in the library alone."""
    return argument(name, lambda f: make_task(**parts), wrong, right, error=error)


def sets(*row):
    """A split of one set of one obstacle."""
    return torch.tensor([[row]])


GOOD_LAYOUTS, READABLE = "make one with uavnav layouts", "{}/layouts: not a readable layout file"
SHAPE, ANEW, FOLDER = "layouts have the shape [n > 0, k, 3]", "generate it anew", "that can be written"
WHOLE, NUMBER, FILE, OVERWRITE = "give a whole number", "give a number", "or a file's path", "overwrite=true"
HEADER, RUN = "its tensors do not fit its header", "give a run's folder"
DAMAGED, NO_RUN, EMPTY = "missing or damaged", "config.yaml: not a run's", "give a new or empty folder"
EXECUTED = "mkdir executed"
LONG = "x" * 300  # more than a file's name may have
KNOWN = ", ".join(sorted(ALGORITHMS))

# fmt: off
REFUSED = {
    "give a name": [{"activation": 3}, {"activation": None}, {"layouts": 3}],
    NUMBER: [{"world": {"sensor_arc": "wide"}}, {"world": {"sensor_arc": math.nan}}, {"lr": "fast"},
        {"world": {"drone_radius": True}}, {"lr": True}, {"lr": math.nan}, {"lr": math.inf}],
    WHOLE: [{"world": {"n_slots": 2.5}}, {"n_seeds": "two"}, {"n_seeds": True}, {"n_seeds": None},
        {"total_frames": 0.5}, {"total_frames": math.inf}, {"total_frames": math.nan}, {"seed": 1.5},
        {"max_steps": "never"}],
    "choose cpu, or a device that this machine has": [
        {"device": one} for one in ("gpu", "meta", "cuda:99", "hpu")],
    "at least 1": [{"n_seeds": 0}, {"n_envs": 0}, {"total_frames": 0}, {"max_steps": 0}],
    "give a number above 0": [{"world": {"n_slots": 0}}],
}
"""Settings, by what each should have been."""

CASES = [
    # a layout file that is read
    all_layouts("missing", missing, "{}/layouts", FILE),
    all_layouts("a folder", a_folder, "{}/layouts", FILE),
    all_layouts("below a file", nothing, "{}/policy/layouts", FILE, part="policy/layouts"),
    all_layouts("a link to itself", itself, "{}/layouts", FILE),
    all_layouts("a pipe", a_pipe, "{}/layouts", FILE),
    all_layouts("without end", endless, "{}/layouts", FILE),
    all_layouts("of 2^40 bytes", large, READABLE),
    all_layouts("a header of brackets", headed("[" * 50_000), READABLE),
    all_layouts("a shape beyond its bytes", lying(shape=[10**9, 10**9]), READABLE),
    all_layouts("a shape beyond any number", lying(shape=[2**40, 2**40]), READABLE),
    all_layouts("no axes", obstacles(lambda b: b[0, 0, 0]), "not []", SHAPE),
    all_layouts("a width in words", obstacles(width='"wide"'), "{}/layouts", ANEW),
    all_layouts("a width of 2,000 digits", obstacles(width="9" * 2000), "{}/layouts: its header does not say",
        ANEW),
    all_layouts("a seed of 5,000 digits", obstacles(generator_seed="9" * 5000),
        "{}/layouts: is not what seed 999", ANEW),
    all_layouts("empty", written(b""), READABLE),
    all_layouts("cut in the data", cut(0.9), READABLE),
    all_layouts("cut in the header", cut(0.05), READABLE),
    all_layouts("five bytes", written(b"\x08\0\0\0\0"), READABLE),
    all_layouts("a header of 2^60 bytes", written(b"\0" * 7 + b"\x10" + b"x" * 90), READABLE),
    all_layouts("longer than it says", lambda path: put(path, path.read_bytes() + b"more"), READABLE),
    all_layouts("a table of text", written("x,y,radius\n1,2,30\n" * 9), READABLE),
    all_layouts("a pickle", pickled, READABLE),
    all_layouts("a file of torch.save", torch_saved, READABLE),
    all_layouts("a flipped bit in the header", flipped(8), READABLE),
    all_layouts("a flipped bit in the data", flipped(-4), "{}/layouts: the checksum does not match", ANEW),
    all_layouts("no header", header(None), "{}/layouts: made for world version None", ANEW),
    all_layouts("another world version", obstacles(world_version="0"), "version 0, this is 1", ANEW),
    all_layouts("no checksum", obstacles(sha256=""), "{}/layouts: the checksum does not match", ANEW),
    all_layouts("another n in the header", obstacles(n="21"), "{}/layouts: its header says n=21, k=4,",
        "not n=20, k=4"),
    all_layouts("no k in the header", obstacles(k=""), "{}/layouts: its header says n=20, k=,",
        "not n=20, k=4"),
    all_layouts("other tensors", tensors(lambda kept: kept.update(a=kept.pop("obstacles"))),
        "no tensor `obstacles`"),
    all_layouts("float64", obstacles(lambda b: b.double()), "not float64", "{}/layouts: layouts are float32"),
    all_layouts("whole numbers", obstacles(lambda b: b.long()), "not int64",
        "{}/layouts: layouts are float32"),
    all_layouts("two axes", obstacles(lambda b: b[0]), "not [4, 3]", SHAPE),
    all_layouts("two columns", obstacles(lambda b: b[..., :2]), "not [20, 4, 2]", SHAPE),
    all_layouts("no sets", obstacles(lambda b: b[:0]), "not [0, 4, 3]", SHAPE),
    all_layouts("nan", obstacles(entry(2, 0, math.nan)), "{}/layouts: obstacle 2 of layout 1 is not finite",
        ANEW),
    all_layouts("an infinite radius", obstacles(entry(0, 2, math.inf)),
        "obstacle 0 of layout 1 is not finite", ANEW),
    all_layouts("a radius of 29.9", obstacles(entry(3, 2, 29.9)), "obstacle 3 of layout 1 has a radius",
        "30 ... 100 px"),
    all_layouts("a radius of 101", obstacles(entry(3, 2, 101.0)), "obstacle 3 of layout 1 has a radius",
        "30 ... 100 px"),
    all_layouts("on the start", obstacles(entry(0, slice(2), 400.0)), "obstacle 0 of layout 1",
        "nearer than 50 px to the start"),
    all_layouts("doctored with its checksum", consistent, "{}/layouts: is not what seed 0 generates", ANEW),
    all_layouts("a seed in words", obstacles(generator_seed="seven"),
        "{}/layouts: is not what seed seven generates", ANEW),
    all_layouts("no seed", obstacles(generator_seed=""), "{}/layouts: is not what seed", ANEW),
    layouts_for("a run", lambda f: train_ppo(f, "new", layouts=str(f / "layouts")), READABLE, GOOD_LAYOUTS,
        "ppo layouts={}/layouts out={}/new", cut(0.9)),
    layouts_for("an environment", lambda f: uavnav.DroneEnv([2], f / "layouts"), "checksum", ANEW,
        spoil=flipped(-4)),
    layouts_for("Gymnasium", lambda f: gymnasium.make(DRONE, layouts=f / "layouts"), READABLE, GOOD_LAYOUTS,
        spoil=cut(0)),
    layouts_for("an evaluation", lambda f: evaluate(f, layouts="tset"), "'tset'", FILE,
        f"{EVALUATE} --layouts tset"),
    layouts_for("a baseline", lambda f: fly(f, layouts="x" * 300), "xxx", FILE,
        f"evaluate random --layouts {LONG}"),
    layouts_for("a picture", lambda f: layouts.load("tset"), "'tset'", FILE, f"{RENDER} --layouts tset"),
    # a layout file that is made
    layouts_for("-1 layouts", lambda f: layouts.generate(-1), "n=-1", "at least 0", f"{NEW_LAYOUTS} --n -1"),
    layouts_for("-1 obstacles", lambda f: layouts.generate(1, -1), "k=-1", "at least 0",
        f"{NEW_LAYOUTS} --k -1"),
    layouts_for("seed -1", lambda f: layouts.generate(1, 1, -1), "seed=-1", "at least 0",
        f"{NEW_LAYOUTS} --seed=-1 --split=test"),
    layouts_for("a trillion", lambda f: layouts.generate(10**12), "n=1000000000000", "at most",
        f"{NEW_LAYOUTS} --n {10**12}"),
    layouts_for("half a set", lambda f: layouts.generate(1.5), "n=1.5", "whole numbers"),
    layouts_for("sets in words", lambda f: layouts.generate("2"), "n=2", "whole numbers"),
    layouts_for("a list", lambda f: layouts.load(["test"]), "layouts=['test']", FILE),
    layouts_for("nothing", lambda f: layouts.load(None), "layouts=None", FILE),
    layouts_for("a NUL byte", lambda f: layouts.load("a\0b"), "no such layout file", FILE),
    layouts_for("a world that is none", lambda f: layouts.load("test", 3), "world=3", "give a World"),
    layouts_for("a world without goals", lambda f: uavnav.goal.generate(1, world=uavnav.World()),
        "is a World", "give a GoalWorld"),
    layouts_for("a world where all stands still", lambda f: moving.generate(1, world=uavnav.World()),
        "is a World", "give a MovingWorld"),
    layouts_for("no tensor", lambda f: layouts.validate([1]), "[1]: is no tensor of layouts",
        "give a tensor"),
    layouts_for("no tensor of goals", lambda f: uavnav.goal.validate([1]), "[1]: is no tensor of layouts",
        "give a tensor"),
    layouts_for("radii of 0", lambda f: uavnav.DroneEnv(layouts=torch.zeros(2, 8, 3)), "radius outside",
        "30 ... 100 px"),
    layouts_for("of less room than the world's", lambda f: make_task(world={"safe_zone": 90}),
        "layouts='train': obstacle ", " is nearer than 90 px to the start"),
    layouts_for("a rung of 5,000 digits", lambda f: layouts.load(f"density-{'9' * 5000}/test"),
        "no such layout file", "give fewer digits", f"{RENDER} --layouts density-{'9' * 5000}/test"),
    layouts_for("a huge rung", lambda f: layouts.load("density-99999999/test"), "k=99999999",
        "at most 20,000,000"),
    layouts_for("no set", lambda f: save_layouts(f / "new", 0), "not [0, 8, 3]", "n > 0",
        f"{NEW_LAYOUTS} --n 0"),
    layouts_for("a folder below a file", lambda f: save_layouts(f / "policy" / "x"), "{}/policy/", FOLDER,
        "layouts --out={}/policy --n=1"),
    layouts_for("in /proc", lambda f: save_layouts("/proc/no/x"), "/proc/no/", FOLDER,
        "layouts --out=/proc/no --n=1"),
    layouts_for("onto a folder", lambda f: save_layouts(f / "thesis"), "{}/thesis: cannot be written",
        FOLDER),
    word(f"{NEW_LAYOUTS} --seed 3", "--seed 3: give --split", "or all splits would have the same layouts"),
    # a policy
    policy("missing", missing, "no policy.safetensors there", "give the folder of a finished run"),
    policy("of a folder without", nothing, "no policy.safetensors there", "give the folder", part="thesis"),
    policy("of a half-finished run", nothing, "no policy.safetensors there", "give the folder", part="half"),
    policy("a pipe", a_pipe, "no policy.safetensors there", "give the folder of a finished run"),
    policy("of 2^40 bytes", large),
    policy("a header of brackets", headed("[" * 50_000)),
    policy("facts of brackets", header("[" * 50_000)),
    policy("a shape beyond its bytes", lying(shape=[10**9, 10**9])),
    policy("a tensor without axes", tensor("policy.0.bias", lambda t: t[0, 0, 0]), HEADER),
    policy("a tensor of whole numbers", tensor("policy.0.bias", lambda t: t.long()), HEADER),
    policy("hidden a million million", facts(hidden=[10**12]), HEADER),
    policy("a hundred layers and one", facts(hidden=[8] * 101)),
    policy("seeds without end", facts(seeds=[0] * (2**20 + 1))),
    policy("epsilon not a number", facts(epsilon=math.nan)),
    policy("stack in words", facts(stack="two")),
    policy("empty", written(b"")),
    policy("cut in the data", cut(0.9)),
    policy("cut in the header", cut(0.02)),
    policy("a pickle", pickled),
    policy("a file of torch.save", torch_saved),
    policy("a layout file", lambda path: put(path, path.with_name("layouts").read_bytes())),
    policy("no header", header(None)),
    policy("a header that is not JSON", header("{")),
    policy("a header that is a list", header("[1]")),
    policy("no seeds in the header", facts(seeds=...)),
    policy("seeds a number", facts(seeds=4)),
    policy("seeds words", facts(seeds="01")),
    policy("no seed", facts(seeds=[]), "contains no seed"),
    policy("a seed too many", facts(seeds=[0, 1, 2]), HEADER),
    policy("hidden a number", facts(hidden=8)),
    policy("hidden words", facts(hidden="8"), "not a readable policy file (hidden=8)"),
    policy("hidden a fraction", facts(hidden=[8.5]), "not a readable policy file (hidden.0=8.5)"),
    policy("hidden negative", facts(hidden=[-8]), "not a readable policy file (hidden.0=-8)"),
    policy("another hidden", facts(hidden=[9]), HEADER),
    policy("too many layers", facts(hidden=[8, 8]), HEADER),
    policy("activation a list", facts(activation=["relu"])),
    policy("an unknown activation", facts(activation="rleu"), "unknown activation 'rleu'",
        "choose from crelu, elu"),
    policy("an unknown algorithm", facts(algorithm="trpo"), "unknown algorithm 'trpo'",
        f"choose from {KNOWN}"),
    policy("an unknown reward", facts(reward="eq15"), "unknown reward 'eq15'",
        "additive, eq14, goal, initial"),
    policy("epsilon a word", facts(epsilon="small")),
    policy("an unknown switch", facts(world={"gravity": 9.81})),
    policy("an unknown task", facts(task="dron"), "unknown task 'dron'", "did you mean drone?"),
    policy("an unknown way to act", facts(acts="beta"), "unknown way to act 'beta'",
        "choose from categorical"),
    policy("an unknown head", facts(head="quantiles 9"), "unknown head 'quantiles'", "choose from direct, d"),
    policy("a plugin's reward", facts(reward="mine", plugins=["my"]), "unknown reward 'mine'",
        "give --plugins my "),
    policy("plugins a number", facts(plugins=3)),
    policy("a world that is a list", facts(world=[90])),
    policy("a time limit of 0", facts(max_steps=0), "not a readable policy file (max_steps=0"),
    policy("a time limit in words", facts(max_steps="never"), "not a readable policy file (max_steps=never"),
    policy("a wrong switch", facts(world={"slots": "first"}),
        "not a readable policy file (world.slots=first"),
    policy("another world version", facts(world_version="0"), "trained in world version 0", "this is 1"),
    policy("a tensor missing", tensor("policy.0.bias", lambda t: None), HEADER),
    policy("a tensor cut", tensor("policy.2.weight", lambda t: t[:, :7]), HEADER),
    policy("a tensor flat", tensor("policy.0.weight", torch.flatten), HEADER),
    policy("31 inputs", tensor("policy.0.weight", widened), "sees 31 numbers", "not 30 and 100"),
    policy("nan", tensor("policy.2.weight", to_nan), "policy.2.weight of seed 0 is not finite", "lower lr",
        error=Diverged),
    policy("another seed", nothing, "seed=7 is not there", "choose from 0 ... 1", seed=7),
    # a run
    run("", "missing", missing, "no such run folder", RUN),
    run("", "a file", a_file, "no such run folder", RUN),
    Case("run: too long a name", "run", nothing, lambda f: Run(LONG), RunError, "xxx…xxx", RUN,
        f"evaluate {LONG}"),
    run("config.yaml", "missing", missing, DAMAGED, RUN),
    run("config.yaml", "empty", written(""), "not a run's configuration", RUN),
    run("config.yaml", "a list", written("[1, 2]"), "not a run's configuration", RUN),
    run("config.yaml", "a word", written("tanh"), "not a run's configuration", RUN),
    run("config.yaml", "a syntax error", written("[1"), DAMAGED, RUN),
    run("config.yaml", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("config.yaml", "a date that is none", written("seed: 2001-13-45"), DAMAGED, RUN),
    run("config.yaml", "a thousand brackets", written("[" * 1000), DAMAGED, RUN),
    run("config.yaml", "a command", written(f"!!python/object/apply:os.system ['{EXECUTED}']"), DAMAGED, RUN),
    run("config.yaml", "a command below", written(f"seed: !!python/object/apply:os.system ['{EXECUTED}']"),
        DAMAGED, RUN),
    run("config.yaml", "a bomb of aliases", written(YAML_BOMB), DAMAGED, RUN),
    run("config.yaml", "a number of 2,000 digits", written("seed: 0x" + "f" * 2000), DAMAGED, RUN),
    *(run(part, how, spoil, DAMAGED, right) for part,
        right in (("config.yaml", RUN), ("meta.json", RUN), ("episodes.parquet", OVERWRITE)) for how,
        spoil in (("a pipe", a_pipe), ("without end", endless), ("of 2^40 bytes", large))),
    run("config.yaml", "a million millions of seeds", replaced("n_seeds: 2", "n_seeds: 1000000000000"),
        "not a run's, its n_seeds=1", RUN),
    run("config.yaml", "a world that is a number", replaced("world:\n", "world: 3\nmore:\n"),
        "not a run's, its world=3", RUN),
    run("config.yaml", "no algorithm", replaced("algorithm: ppo\n", ""), "not a run's, its algorithm=None",
        RUN),
    run("config.yaml", "no seed", replaced("\nseed: 0\n", "\n"), "not a run's, its seed=None", RUN),
    run("config.yaml", "a seed in words", replaced("\nseed: 0\n", "\nseed: zero\n"),
        "not a run's, its seed=zero", RUN),
    run("config.yaml", "no seeds", replaced("n_seeds: 2", "n_seeds: 0"), "not a run's, its n_seeds=0", RUN),
    run("config.yaml", "cut within a key", cut_before("_radius_max"), DAMAGED, RUN),
    run("config.yaml", "another algorithm", replaced(": ppo", ": td3"), "algorithm=td3; ", "choose from",
        VERIFIES),
    run("config.yaml", "dqn's keys", replaced(": ppo", ": dqn"), "there is no key 'frames_per_batch'",
        "choose from", VERIFIES, ConfigError),
    run("config.yaml", "an unknown key", added("speed: 3\n"), "there is no key 'speed'", "choose", VERIFIES,
        ConfigError),
    run("config.yaml", "a key that is a number", added("3: 3\n"), "not a run's, its 3=3", RUN, VERIFIES),
    run("config.yaml", "a wrong value", replaced("gamma: 0.99", "gamma: 9"), "not a run's, its gamma=9", RUN,
        VERIFIES),
    *(run("config.yaml", f"without its {line.partition(':')[0]}", replaced(f"{line}\n", ""),
        f"not a run's, its {line.partition(':')[0]}=None", RUN, VERIFIES)
        for line in ("preset: paper", "task: drone", "reward: eq14", "layouts: train", "gamma: 0.99",
            "total_frames: 64")),
    Case("run/config.yaml: a layout file that is gone", "run/config.yaml",
        replaced("layouts: train", "layouts: tset"), verify, LayoutError,
        "layouts='tset': no such layout file", FILE, VERIFY),
    run("meta.json", "missing", missing, DAMAGED, RUN),
    run("meta.json", "empty", written(""), DAMAGED, RUN),
    run("meta.json", "cut", cut(0.5), DAMAGED, RUN),
    run("meta.json", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("meta.json", "many brackets", written("[" * 100_000), DAMAGED, RUN),
    run("meta.json", "a list", written("[1]"), "not a run's facts", RUN),
    run("meta.json", "no frames", meta(frames=...), "not a run's, its frames=None", RUN),
    run("meta.json", "frames in words", meta(frames="many"), "not a run's, its frames=many", RUN),
    run("meta.json", "versions a list", meta(versions=[1]), "not a run's, its versions=[1]", RUN),
    run("meta.json", "plugins a number", meta(plugins=3), "not a run's, its plugins=3", RUN),
    run("meta.json", "threads beyond any machine", meta(threads=10**18), "not a run's, its threads=1000000",
        RUN),
    run("meta.json", "a wall time of ages", meta(wall_seconds=1e14), "not a run's, its wall_seconds=10000",
        RUN),
    run("meta.json", "compiled in words", meta(compiled="yes"), "not a run's, its compiled=yes", RUN),
    run("meta.json", "a number of 1,000 digits", meta(frames=10**999), DAMAGED, RUN),
    run("", "under way", status("running"), "the run is not finished", "that trained it again"),
    *(run(f"{name}.parquet", how, spoil, wrong, OVERWRITE) for name in ("episodes", "progress") for how,
        spoil,
        wrong in (("missing", missing, DAMAGED), ("a folder", a_folder, DAMAGED),
        ("empty", written(b""), DAMAGED), ("cut", cut(0.7), DAMAGED),
        ("text", written("seed,frame\n0,1\n"), DAMAGED), ("a pickle", pickled, DAMAGED),
        ("one that unfolds", unfolding, DAMAGED), ("lists in a column", columns(seed=[1]), DAMAGED),
        ("structures in a column", columns(seed={"seed": 1}), DAMAGED),
        ("other columns", table(lambda t: t.rename(columns={"frame": "time"})), "its columns are not"),
        ("words for numbers", table(lambda t: t.astype({"seed": str})), "its columns are not"))),
    Case("run/policy.safetensors: missing", "run/policy.safetensors", missing, evaluate, PolicyError,
        "{}/run: no policy.safetensors there", "give the folder of a finished run", EVALUATE),
    run("policy.safetensors", "cut", cut(0.5), "not a readable policy", "of a finished run", EVALUATES,
        PolicyError),
    run("policy.safetensors", "a pipe before a repeat", a_pipe, DAMAGED, OVERWRITE, VERIFIES),
    run("policy.safetensors", "cut before a repeat", cut(0.5), DAMAGED, OVERWRITE, VERIFIES),
    *(run("evaluation.parquet", how, spoil, wrong, "evaluate the run again", REPORTS) for how, spoil,
        wrong in (("cut", cut(0.7), DAMAGED),
        ("no modes", table(lambda t: t.drop(columns="mode")), "its columns are not"),
        ("rewards in words", table(lambda t: t.astype({"reward": str})), "its columns are not"))),
    # where a run is to go
    out("a file", "run", a_file, "out={}/run: is a file", "give a folder"),
    out("below a file", "thesis", nothing, "{}/policy is not", FOLDER, target="policy/run"),
    out("in /proc", "thesis", nothing, "out=/proc/nowhere/run: ", FOLDER, target="/proc/nowhere/run"),
    out("too long a name", "thesis", nothing, "xxx: cannot be written", FOLDER, target=LONG),
    out("in a folder that is read-only", "thesis", read_only, "{} is not", FOLDER, target="new"),
    out("among other files", "thesis", nothing, "out={}/thesis: contains other files", "give a new or empty",
        target="thesis"),
    out("over other files", "thesis", nothing, "contains other files", "give a new or empty", "thesis",
        overwrite=True),
    out("over another program's", "thesis/config.yaml", written("kind: Pod"), NO_RUN, EMPTY, "thesis",
        overwrite=True),
    out("over another's run", "thesis/config.yaml", written("algorithm: td3"), NO_RUN, EMPTY, "thesis",
        overwrite=True),
    out("over a damaged config", "run/config.yaml", written("[1"), "{}/run/config.yaml: " + DAMAGED, "",
        overwrite=True),
    out("a config of keys that are numbers", "run/config.yaml", added("1: 2\n"), NO_RUN + ", its 1=1", EMPTY),
    out("another learning rate", "run", nothing, "contains a run with lr=0.0003, not 0.1", OVERWRITE, **OTHER,
        lr=0.1),
    out("another network", "run", nothing, "contains a run with hidden=[8], not [9]", OVERWRITE, **OTHER,
        hidden=[9]),
    out("another algorithm's", "run/config.yaml", replaced(": ppo", ": dqn"), "algorithm=dqn, not ppo",
        OVERWRITE, **OTHER),
    out("finished, a table gone", "run/episodes.parquet", missing, "{}/run/episodes.parquet: missing",
        OVERWRITE),
    out("facts cut", "run/meta.json", cut(0.5), "{}/run/meta.json: " + DAMAGED, RUN),
    out("in use", "new", in_use, "another process is writing this run", "wait for it", target="new"),
    out("in use, to be overwritten", "run", in_use, "another process is writing", "wait for it",
        overwrite=True),
    out("a folder for a lock", "run/.lock", Path.mkdir, "out={}/run: cannot be written", FOLDER,
        overwrite=True),
    Case("out: another layout file than before", "run/meta.json", meta(layouts={"sha256": "0" * 64}),
        train_ppo, OtherRun, "the split layouts=train has changed", OVERWRITE,
        f"ppo {words(PPO)} out={{}}/run"),
    # a run that was interrupted
    half("every snapshot cut", snapshots(cut(0.9)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot flipped", snapshots(flipped(-4)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot empty", snapshots(written(b"")), "damaged, its checksum does not match", OVERWRITE),
    half("frames a word in every snapshot", snapshots(doctored(state_facts(frames="many"))),
        "and there is no other", OVERWRITE),
    half("its replay gone", replay_gone, "missing or not readable", OVERWRITE),
    half("of another version of torch", newer_torch,
        f"saved with version of torch={torch.__version__}, not 9.9.9, and", OVERWRITE),
    half("another seed", nothing, "contains a run with seed=0, not 7", OVERWRITE, **OTHER, seed=7),
    half("another seed everywhere", reseeded, "saved with seed=0, not 7", OVERWRITE, seed=7),
    Case("half: read", "half", nothing, lambda f: Run(f / "half"), RunError,
        "{}/half: the run is not finished", "that trained it again", "verify {}/half"),
    # a configuration
    config({"activatoin": "relu"}, "did you mean activation?", "there is no key 'activatoin'"),
    config({"batch_size": 3}, "choose from", "there is no key 'batch_size'"),
    config({"epochs": 3}, "choose from", "there is no key 'epochs'", "dqn"),
    config({"preset": "papr"}, "did you mean paper?"),
    config({"activation": "rleu"}, "did you mean relu? choose from crelu, elu"),
    *(config(settings, right) for right, several in REFUSED.items() for settings in several),
    config({"reward": "eq15"}, "did you mean eq14? choose from additive, eq14, goal, initial"),
    config({"reward": "goal"}, "choose task=goal, or another reward", "reward=goal: this task has no goal; "),
    config({"world": {"slots": "first"}}, "choose from listed, nearest"),
    config({"world": {"padding": "ones"}}, "choose from far, zeros"),
    config({"world": {"start_heading": "down"}}, "choose from random, up"),
    config({"world": {"sensor_arc": 0}}, "above 0", "world.sensor_arc=0; "),
    config({"world": {"sensor_arc": 361}}, "at most 360", "world.sensor_arc=361; "),
    config({"world": {"border": 30}}, "must divide width=800", "world.border=30 "),
    config({"world": {"slotz": "nearest"}}, "did you mean world.slots?", "there is no key 'world.slotz'"),
    config({"world": 3}, "give fields of the world, such as world.width=800"),
    config({"world": "flat"}, "give fields of the world, such as world.width=800"),
    config({"task": "dron"}, "did you mean drone? choose from drone, goal, moving, space, space-moving"),
    config({"slots": "listed"}, "did you mean world.slots?", "there is no key 'slots'"),
    config({"init": "xavier"}, "choose from default, orthogonal"),
    config({"compile": "maybe"}, "choose from auto, off, on"),
    config({"loss": "l1"}, "choose from huber, squared", algorithm="dqn"),
    config({"seed": -1}, "at least 0"),
    config({"seed": 2**31}, "at most 2147483647"),
    config({"lr": -1.0}, "at least 0"),
    config({"gamma": 1.1}, "give a number of at least 0 and at most 1"),
    config({"tau": 1.1}, "give a number of at least 0 and at most 1", algorithm="sac"),
    config({"gae_lambda": 1.1}, "give a number of at least 0 and at most 1", algorithm="a2c"),
    config({"minibatch_size": 64}, "choose from", "there is no key 'minibatch_size'", "a2c"),
    config({"epsilon_end": 2.0}, "at most 1", algorithm="dqn"),
    config({"hidden": 64}, "give a list of numbers in brackets"),
    config({"hidden": []}, "give at least one layer, each of at least 1 unit"),
    config({"hidden": [64, 0]}, "at least 1 unit"),
    config({"hidden": [64, "x"]}, WHOLE, "hidden.1=x; "),
    config({"hidden": [8.5]}, WHOLE, "hidden.0=8.5; "),
    config({"n_envs": 7}, "give a divisor of the 2048 frames of an iteration"),
    config({"n_envs": 6}, "give a multiple or a divisor of frames_per_update=4", algorithm="dqn"),
    config({"minibatch_size": 100}, "give a divisor of frames_per_batch=2048"),
    config({"minibatch_size": 1}, "at least 2"),
    config({"buffer_size": 1}, "give more than n_envs=1", algorithm="dqn"),
    word("ppo overwrite=2", "overwrite=2; ", "choose from false, true"),
    word("dqn evaluate=maybe", "evaluate=maybe; ", "choose from false, true"),
    word("ppo checkpoint_seconds=-1", "checkpoint_seconds=-1; ", "at least 0"),
    word("ppo plugins=nowhere", "plugins=nowhere: is no module in ", "without .py"),
    word("ppo plugins=thesis.py", "plugins=thesis.py: ", "without .py"),
    word(f"{EVALUATE} --plugins nowhere", "--plugins nowhere: ", "without .py"),
    word("poo", "algorithm=poo; ", f"did you mean ppo? choose from {KNOWN}"),
    word("activation=relu", "algorithm=; ", f"choose from {KNOWN}"),
    word("ppo relu", "'relu'", ""),
    word("ppo -m activation=relu,rleu", "activation=rleu; ", "did you mean relu?"),
    word("ppo -m seed=1,2 out=new", "out=new: two runs of the sweep", "name what differs"),
    # what is no number, no name, too large or too deep
    *(config({key: value}, WHOLE) for key in ("seed", "n_seeds", "n_envs") for value in ([1], "")),
    *(config({key: 2**64}, "at most 9,007,199,254,740,992") for key in ("total_frames",
        "minibatch_size")),
    *(config({key: [1]}, "choose from") for key in ("preset", "compile")),
    *(config({key: [1]}, "give a name") for key in ("task", "reward", "activation")),
    config({"lr": 10**400}, NUMBER, "lr="),
    config({"hidden": [1] * 101}, "give at most 100", "hidden: 101 layers"),
    config({"critic_coeff": 0.0}, "give a number above 0", "critic_coeff=0.0"),
    config({"world": {"width": 10**7}}, "at most 1,000,000"),
    config({"world": {"slots": []}}, "choose from"),
    misused("a world's width", lambda f: uavnav.World(width=10**400), "width=1", "at most "),
    misused("a stack that is true", lambda f: make_task(stack=True), "stack=True", "give a whole number"),
    misused("a world's slots", lambda f: uavnav.World(slots=[]), "slots=[]", "choose from"),
    misused("a task", lambda f: uavnav.DroneEnv(task=[]), "task=[]", "choose from"),
    misused("a run of nothing", lambda f: ppo.train(None, f / "new"), "config=None", "PPOConfig()"),
    misused("seconds", lambda f: ppo.train(ppo.PPOConfig(), f / "new", checkpoint_seconds=[]), "=[]", NUMBER),
    misused("until 0", lambda f: ppo.train(ppo.PPOConfig(), f / "new", until=0), "until=0", "at least 1"),
    misused("a shape", lambda f: uavnav.DroneEnv(3), "batch_size=3", "whole numbers"),
    misused("a shape of no rows", lambda f: uavnav.DroneEnv([0]), "batch_size=[0]", "whole numbers above 0"),
    misused("a large shape", lambda f: uavnav.DroneEnv([10**7, 9]), "batch_size", "at most"),
    misused("seeds in words", lambda f: uavnav.DroneEnv([2], seeds="ab"), "seeds=ab", "whole"),
    misused("a device", lambda f: uavnav.DroneEnv(device="gpu"), "device=gpu", "choose cpu"),
    misused("no such device", lambda f: uavnav.DroneEnv(device="cuda:99"), "device=cuda:99", "choose cpu"),
    misused("options", lambda f: uavnav.gym.DroneGymEnv("test").reset(options=[3]), "[3]", "map"),
    misused("a policy", lambda f: uavnav.evaluate_policy(3), "policy=3", "load_policy"),
    word(f"{VERIFY} --frames=--", "--frames=--: ", "give a value"),
    word("render random --out 'a\nb'", "a\\nb: ", "choose an .mp4"),
    word("evaluate random --max-steps=2147483648", "max_steps=2147483648", "at most 1,000,000"),
    word("ppo 'seed=1\n2'", "seed=1\\n2", WHOLE),
    word(f"ppo seed={'9' * 5000}", "seed=inf", WHOLE),
    word(f"ppo seed={'[' * 500}{']' * 500}", "seed=[[[", "cannot be read"),
    word("ppo 'device='\"'\"'cpu'", "device='cpu", "cannot be read"),
    word("ppo preset=3", "preset=3", "choose from"),
    word(f"ppo preset={'x' * 300}", "preset=xxx", "choose from "),
    word("ppo -m seed=range(0,1000000000)", "too long", "at most 1,000"),
    word("ppo -m seed=range(0,9,0)", "it is no range", "range(start,stop,step)"),
    word("ppo -m seed=range(0,100) n_seeds=range(1,101)", "has 10,000 runs", "at most 1,000"),
    word("ppo out=new ~out", "'~out'", "is no setting"),
    word("ppo out=[1]", "out=[1]", "give a folder"),
    word("ppo out=", "out=", "give a folder"),
    word("ppo out=/", "out=/: contains other files and no run", "give a new or empty folder"),
    word("ppo activation=**", "activation=**; ", "choose from"),
    word("study paper engine=slurm partition=cpu time=12:00:00 memory=4", "time=12:00:00", "a whole number"),
    word("ppo 'out=\"\0\"'", "no folder can have such a name", "give another"),
    word("ppo total_frames=1e15 compile=off", "rows of progress a seed", "give fewer frames"),
    word("dqn batch_size=1e12 compile=off", "of a batch would take", "give"),
    word("ppo n_seeds=1e15 compile=off", "n_seeds=1000000000000000.0; ", "at most 1,048,576"),
    word("ppo n_seeds=1e6 compile=off", "would take at least", "fewer seeds"),
    word(f"{VERIFY} --frames {2**64}", "is too large", "give at most"),
    word(f"{VERIFY} --frames {'9' * 5000}", "invalid int value", "--help"),
    word("evaluate random --seeds=1000000", "--seeds 1000000", "at most 1,000"),
    word(f"{RENDER} --steps 1000000000", "--steps 1000000000", "at most 100,000"),
    # arguments
    argument("0 episodes", lambda f: fly(f, episodes=0), "episodes=0", "1 to 1000",
        "evaluate random --episodes=0"),
    argument("1001 episodes", lambda f: fly(f, episodes=1001), "=1001", "1 to 1000",
        "evaluate random --episodes=1001"),
    argument("0 steps", lambda f: fly(f, max_steps=0), "max_steps=0", "at least 1",
        "evaluate random --max-steps=0"),
    argument("0 seeds of a script", None, "--seeds 0", "at least 1", "evaluate random --seeds=0"),
    argument("seeds of a rule", None, "--seeds 2", "only random has several", "evaluate reactive --seeds=2"),
    misused("a reward", lambda f: fly(f, reward="eq15"), "reward='eq15'", "choose from additive, eq14"),
    misused("a slot order", lambda f: uavnav.World(slots="first"), "slots=first",
        "choose from listed, nearest"),
    misused("a box's depth", lambda f: SpaceWorld(depth=280), "depth=280", "give above 280 px"),
    misused("a border", lambda f: uavnav.World(border=30), "border=30", "must divide"),
    argument("an activation", lambda f: uavnav.networks.Activation("rleu"), "activation='rleu'",
        "did you mean relu"),
    misused("a time limit", lambda f: uavnav.DroneEnv(max_steps=0), "max_steps=0", "a whole number from 1"),
    misused("a time limit in half steps", lambda f: uavnav.DroneEnv(max_steps=1.5), "max_steps=1.5",
        "a whole number from 1"),
    argument("seeds", lambda f: uavnav.DroneEnv([3], seeds=[1, 2]), "2 seeds for batch_size [3]",
        "one per agent"),
    argument("seeds without agents", lambda f: uavnav.DroneEnv(seeds=[1, 2]), "2 seeds for batch_size []",
        "one per agent"),
    *(argument(f"a drone's action {n}", lambda f, n=n: gym_env().step(n), f"action={n}", "from 0 to 99")
        for n in (-1, 100, 2.7)),
    *(argument(f"drones' actions {n}", lambda f, n=n: gym_envs().step(np.array(n)), "action=[",
        "from 0 to 99 for each of the 2 rows") for n in ([5, -1], [5, 100], [1, 2, 3])),
    *(argument(f"a drone's layout {n!r}", lambda f, n=n: gym_env(layout=n), "options layout=",
        "from 0 to 999") for n in (-1, 1000, 2.5, "3", [1, 2])),
    argument("no drone", lambda f: uavnav.gym.DroneVectorEnv(0), "num_envs=0", "at least 1"),
    argument("a screen", lambda f: uavnav.gym.DroneGymEnv(render_mode="screen"), "'screen'",
        "choose None, human or rgb_array"),
    argument("a screen of several", lambda f: uavnav.gym.DroneVectorEnv(render_mode="screen"), "'screen'",
        "rgb_array"),
    argument("a picture's kind", lambda f: save_picture(f / "x.bmp"), "x.bmp", ".gif or .png",
        f"{RENDER} --out x.bmp"),
    argument("a picture's folder", lambda f: save_picture(f / "policy/x.png"), "policy/x.png",
        "a path that can be written", f"{RENDER} --out {{}}/policy/x.png"),
    *(word(f"{VERIFY} --frames={n}", f"frames={n}; ", "give a number of at least 1") for n in (0, -5)),
    # parts of a task, and what goes wrong in it
    of_task("a key of a world", "key 'world.sensor_ark'", "did you mean world.sensor_arc? choose from 18",
        world={"sensor_ark": 90}),
    of_task("a speed", "speed_min=3", "give 0 to speed_max=2 px a step", task="moving",
        world={"speed_min": 3.0}),
    of_task("sensed velocities", "sense_velocity=1", "choose from false, true", task="moving",
        world={"sense_velocity": 1}),
    of_task("a key of a moving world", "no key 'world.speed'", "did you mean world.speed_min? choose from ",
        task="moving", world={"speed": 1}),
    of_task("a key of a space", "no key 'world.speed_max'", "did you mean world.obstacle_radius_max?",
        task="space", world={"speed_max": 1.0}),
    *(of_task(f"{task}'s layouts: {says}", says, "", LayoutError, task=task, layouts=split) for task,
        split,
        says in (("moving", layouts.generate(2, 3), "layouts have the shape [n > 0, k, 5], not [2, 3, 3]"),
        ("moving", sets(-1.0, 0, 30, 0, 0), "obstacle 0 of layout 0 has its centre outside the window"),
        ("moving", sets(0.0, 0, 30, 0, math.nan), "obstacle 0 of layout 0 is not finite"),
        ("space", torch.ones(2, 3, 3), "layouts have the shape [n > 0, k, 4], not [2, 3, 3]"),
        ("space", sets(400.0, 300, 340, 30), "obstacle 0 of layout 0 is nearer than 50 px to the start"),
        ("space", sets(0.0, 0, 0, 29), "obstacle 0 of layout 0 has a radius outside 30 ... 100 px"),
        ("space-moving", sets(0.0, 0, 601, 30, 0, 0, 0),
        "obstacle 0 of layout 0 has its centre outside the box"))),
    *(misused(f"faults {given}", lambda f, given=given: Faults(**given), wrong, right) for given, wrong,
        right in (({"noise": -1}, "noise=-1; ", "a number of at least 0"),
        ({"noise": math.inf}, "noise=inf; ", NUMBER), ({"lost": 1.5}, "lost=1.5; ", "at most 1"),
        ({"late": 1.5}, "late=1.5; ", WHOLE), ({"late": 10**9}, "late=1000000000; ", "at most 1000"),
        ({"sticky": True}, "sticky=True; ", NUMBER))),
    config({"stack": 0}, "at least 1"),
    config({"faults": {"nois": 5}}, "did you mean faults.noise? choose from ", "no key 'faults.nois'"),
    config({"faults": {"noise": -1}}, "at least 0"),
    config({"faults": {"lost": "half"}}, NUMBER),
    config({"faults": {"late": 0.5}}, WHOLE),
    config({"faults": "noise"}, "give fields of the faults, such as faults.noise=0.0"),
    config({"noise": 5}, "did you mean faults.noise? choose from ", "there is no key 'noise'"),
    # words of other commands
    word("layouts --split trian", "argument --split: trian", "did you mean train? choose from all, test"),
    word("layouts --slpit train", "there is no argument --slpit", "did you mean --split?"),
    word("layouts --check tset", "layouts='tset': no such layout file",
        "(did you mean test?); choose from train"),
    word("evaluate reactiv", "reactiv: no such run folder; give a run's", "did you mean reactive?"),
    word("evaluate random --acros density", "there is no argument --acros", "did you mean --across?"),
    word("evaluate random --epsiodes 3", "no argument --epsiodes", "did you mean --episodes?"),
    word(f"{VERIFY} --frames=3x", "argument --frames: invalid int value: '3x'", ""),
    *(word(f"{one} reactiv", "reactiv: no policy", "did you mean reactive?") for one in SHOWS),
    *(word(f"{one} random --sampled", "no argument --sampled", "") for one in SHOWS),
    *(word(f"{RENDER} --layout={n}", f"--layout {n}", "choose from 0 to 999") for n in (1000, -1)),
    *(word(f"{RENDER} --{key}=0", f"--{key}", "give") for key in ("steps", "every", "speed", "width")),
    word(f"{RENDER} --out=x.gfi", "x.gfi (did you mean .gif?)", "choose an .mp4, .gif or .png file"),
    word(f"{RENDER} --out=x.gif --every=100000", "0.0003 pictures per second", "0.01 at least"),
    word(f"{RENDER} --out=x.gif --speed=2", "60 pictures per second", "50 at most: draw fewer"),
    word(f"{RENDER} --activation=tanh", "--activation tanh: runs know", "with a .zip"),
    word(f"{RENDER} nowhere", "nowhere: no policy.safetensors there", "give the folder"),
    word(f"{RENDER} --faults noise=-1", "--faults noise=-1: noise=-1.0", "at least 0"),
    word(f"{RENDER} --out=/proc/x.png", "/proc/x.png: cannot be written", ""),
    word("play nowhere", "nowhere: no policy.safetensors there", "give the folder"),
    word("play {}/policy --seed 9", "seed=9 is not there", "choose from"),
    word("play --layout 1000", "--layout 1000", "choose from 0 to 999"),
    word("play --layouts nowhere", "nowhere", "no such layout file"),
    word("play --max-steps 0", "--max-steps 0", "give at least 1"),
    word("play --activation tanh", "--activation tanh: runs know", "with a .zip"),
    word("play --out policy/page.html", "policy/page.html", "cannot be written"),
    word("play --out .", ".: cannot be written", ""),
    word("play --out /", "/: cannot be written (it is a folder)", "give a path that can be written"),
    word("play --out /proc/x/page.html", "/proc/x/page.html", "cannot be written ("),
    word("play --keep thesis/chapter.txt", "chapter.txt: cannot be read", "give human.csv"),
    word("play --keep nowhere.csv", "nowhere.csv: cannot be read", "give human.csv"),
    word("play --person -1", "--person -1", "give at least 0"),
    word("bench --only trainig", "argument --only: trainig", "did you mean training? choose from"),
    word("bench --only", "--only", "expected at least one argument"),
    word("bench --quik", "there is no argument --quik", "did you mean --quick?"),
    word("bench --out .", ".: cannot be written", "is a folder"),
    word("bench --out thesis/chapter.txt", "thesis/chapter.txt: contains something else", "give a new file"),
    word("bench --quick --only gymnasium memory", "--quick: memory cannot be quick", "leave out --quick"),
    # settings and flags of `uavnav train`
    word("ppo +speed=3", "there is no key 'speed'", "choose from "),
    word("ppo hydra.run.dir=x", "there is no key 'hydra.run.dir'", "choose from "),
    word("ppo world.slot=listed", "there is no key 'world.slot'", "did you mean world.slots?"),
    word("ppo out=${activatoin}", "there is no key 'activatoin'",
        "did you mean activation? choose from "),
    word("ppo layouts=nowhere", "layouts='nowhere': no such layout file; choose from train, validation, test",
        FILE),
    word("ppo total_frames=1.5", "total_frames=1.5", WHOLE),
    word("ppo =3", "'=3'", "is no setting"),
    word("ppo hidden=[64", "hidden=[64: its value cannot be read",
        "quote brackets and blanks: 'hidden=[64,64]'"),
    word("ppo --activation tanh", "there is no flag --activation; ",
        "settings are key=value: activation=tanh"),
    word("ppo --n-seeds=4", "there is no flag --n-seeds; ", "settings are key=value: n_seeds=4"),
    word("ppo --helpp", "there is no flag --helpp", "(did you mean --help?); settings are key=value"),
    word("ppo --cfg everything", "--cfg/-c: everything: choose from job", "uavnav train --help says more"),
    word("ppo activation=rleu --cfg job", "activation=rleu; ", "choose from crelu"),
    word("ppo activation=tanh,relu", "activation: give one value", "or -m to train with each in turn"),
    word("ppo activation=tanh,relu -m out=one", "out=one: two runs of the sweep", "name what differs"),
    # ladders, worlds of others, and what is compared
    word("evaluate reactive --across density --episodes 0", "episodes=0, max_steps=2000",
        "give 1 to 1000 episodes"),
    word("evaluate reactive --across densty", "densty", "did you mean density?"),
    word("evaluate reactive --transfer", "--transfer reactive: names no run",
        "folders of runs of several tasks"),
    word("evaluate {}/run --transfer --episodes 0", "episodes=0, max_steps=2000", "give 1 to 1000 episodes"),
    word("evaluate reactive --transfer --faults noise=5", "--faults noise=5: ladders and tasks",
        "leave it out"),
    word("evaluate reactive --transfer --across arc", "not allowed with argument", ""),
    word("evaluate {}/run nowhere --episodes 2", "nowhere: no such run folder", RUN),
    word("evaluate {}/rum", "no such run folder; give a run's folder", "(did you mean {}/run?)"),
    word("evaluate {}/run --out rows", "--out rows: the rows of a run are kept in its folder", "leave it"),
    word("evaluate {}/run --at 1", "kept no policies at=1", "give a share between 0 and 1"),
    word(f"{RENDER} --task goal", "--task goal: what was trained flies in its own task", "leave it out"),
    *(word(f"evaluate random --plugins={name}", f"--plugins {name}: is no module's name", "as my_module")
        for name in ("./x", "my.py.", ".my")),
    word("compare reactive", "reactive: there is nothing to compare it with",
        "at least two, such as ppo-best reactive"),
    word("compare {}/run {}/rum", "no such run folder", "(did you mean {}/run?)"),
    word("compare {}/run reactiv", "no such run folder", "(did you mean reactive?)"),
    # files that are written, and policies that are exported
    *(word(f"evaluate random --out {folder}", f"{folder}/random.parquet: cannot be written (",
        "path that can be wri") for folder in ("/proc/x", "policy", "policy/rows")),
    word("playground thesis --out .", ".: cannot be written (it is a folder)",
        "give a path that can be written"),
    word("export nowhere --out new.pt2", "no policy.safetensors there", "give the folder of a finished run"),
    word("export reactive --out new.pt2", "reactive: a scripted policy has no network", "give a trained one"),
    word("export {}/run --out policy/new.pt2", "policy/new.pt2: cannot be written (", "path that can be wri"),
    word("export {}/run --seed 7 --out new.pt2", "seed=7 is not there", "choose from 0 ... 1"),
    # what Stable-Baselines3 has saved
    *(word(f"{name} {words}--activation tanh", "--activation tanh: runs know their own",
        "give it with a .zip") for name,
        words in (("evaluate", "random "), ("play", "reactive "), ("export", "run --out a.onnx "))),
    *(word(f"{name} theirs.zip{out}", "theirs.zip: it does not tell the activation",
        "give --activation, one of") for name,
        out in (("evaluate", ""), ("render", " --out a.gif"), ("play", ""), ("export", " --out a.onnx"))),
    word("evaluate theirs.zip --activation rleu", "theirs.zip: unknown activation 'rleu'",
        "choose from crelu, "),
    word("evaluate nowhere.zip --activation relu", "nowhere.zip: no such file",
        "what model.save of PPO, A2C or DQN wrote"),
    word("evaluate theirs.zip other/theirs.zip --activation relu --out rows", "--out rows: two policies",
        "rename one"),
    word("evaluate ppo-tanh other/ppo-tanh.zip --activation relu --out rows", "--out rows: two policies",
        "rename one"),
    # rungs
    layouts_for("a rung without a split", lambda f: layouts.load("density-12"), "no such layout file",
        "such as density-12/test"),
    layouts_for("a rung's split", lambda f: layouts.load("density-12/tset"), "'density-12/tset'",
        "did you mean test?"),
    layouts_for("a rung in words", lambda f: layouts.load("slalom-wide/test"), "no such layout file",
        "give a rung and a split"),
    layouts_for("a gap of 500", lambda f: layouts.load("slalom-500/test"), "gap=500", "give 1 to 480 px"),
    layouts_for("a gap of 0", lambda f: layouts.load("slalom-0/test"), "gap=0", "give 1 to 480 px"),
    # names spelt wrongly in Python
    misused("a reward spelt wrongly", lambda f: uavnav.DroneEnv(reward="eq41"), "reward='eq41'",
        "did you mean eq14"),
    misused("slots spelt wrongly", lambda f: uavnav.World(slots="nearst"), "slots=nearst",
        "did you mean nearest"),
    misused("a preset spelt wrongly", lambda f: ppo.PPOConfig(preset="fats"), "preset=fats",
        "did you mean fast"),
    layouts_for("spelt wrongly", lambda f: layouts.load("trian"), "layouts='trian'", "did you mean train"),
    argument("a name", lambda f: uavnav.evaluate_polcy, "no attribute 'evaluate_polcy'",
        "did you mean evaluate_policy", error=AttributeError),
]
# fmt: on
