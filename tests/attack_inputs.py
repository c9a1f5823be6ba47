"""Hostile inputs by class, as strategies of Hypothesis: what `attack` tries, and the good files that it begins with."""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import json
import math
import os
import random
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pandas as pd
import torch
import warm
import yaml
from hypothesis import strategies as st
from spoiling import a_folder, cut, itself, missing, put

import uavnav
from uavnav import commands, evaluate, files, studies
from uavnav.__main__ import main, module_of
from uavnav.algorithms import ALGORITHMS, dqn, ppo
from uavnav.help import of_command
from uavnav.help.choices import Parser
from uavnav.help.terminal import end_quietly
from uavnav.runs import POLICY, Run
from uavnav.runs.tables import RunError
from uavnav.studies import search, tuning
from uavnav.tasks import layouts
from uavnav.tasks.faults import Faults
from uavnav.tasks.simulator import TASKS, make_task
from uavnav.train import share
from uavnav.train.verify import verify
from uavnav.training import shares
from uavnav.training.config import PARTS, parts_of
from uavnav.training.recorder import Interrupted

TYPED = (ValueError, TypeError, RunError, gymnasium.error.Error)
"""What the library may raise; ConfigError, LayoutError and PolicyError are ValueErrors."""
SMALL = {"total_frames": 64, "n_worlds": 2, "hidden": [4], "compile": "off"}
OWN = {
    "ppo": {"frames_per_batch": 64, "minibatch_size": 32, "epochs": 1},
    **{name: {"learning_starts": 16, "batch_size": 8, "buffer_size": 256} for name in ("dqn", "c51", "sac")},
}
QUICK = {
    "evaluate": ["--episodes", "2", "--max-steps", "5"],
    "render": ["--steps", "2", "--out", "flight.png"],
    "export": ["--out", "policy.pt2"],
    "layouts": ["--out", "banks", "--n", "4", "--k", "4"],
    "study": ["study.yaml", "out=study", "report=false", "jobs=1"],
    "play": ["--max-steps", "5"],
}
"""Words that keep a command short, unless the attack takes their place."""
GIVEN = {"RUN": ("run", "reactive", "model.zip", POLICY), "FOLDER": ("run", "."), "NAME": ("study.yaml",)}
"""Good words by the placeholder of a parser."""
TEXT_MOST = 100_000


class Case(NamedTuple):
    """How to spoil a folder, what to do there, and both in words; works: whether it may take for ever by itself."""

    told: str
    act: Callable[[], int | None]
    spoil: Callable[[Path], Any] = lambda folder: None
    works: bool = False


# -- hostile values --------------------------------------------------------------------------------------------------

NUMBERS = (0, -1, 1, 2, 3, 7, 0.5, -0.5, 2**31 - 1, 2**31, 2**63 - 1, 2**63, 10**22, 10**400, 1e308, -1e308, 5e-324)
NUMBERS += (math.inf, -math.inf, math.nan, True, False, None)
WORDS = ("", " ", "\0", "a\nb", "\x1b[2J", "\udc80", "\ud800", "x" * 300, "x" * 5000, "x" * TEXT_MOST, "y " * 9999)
WORDS += ("..", ".", "a/b", "run", "half", "nowhere", "{lr}", "{0.x}", "{lr.__class__}", "{:>999999999}", "%s%n", "*")
WORDS += ("${out}", "${oc.env:HOME}", "[", "[[1,2", "{a:", "a,b", "range(0,9)", "nan", "1e999", "null", "true", "0x1f")
WORDS += ("2001-13-45", "é" * 300, "-", "--", "-1", "!!python/object/apply:os.mkdir [x]", "1_0", "١٢", "1e3", "on")
WORDS += ("train", "test", "density-4/test", "density-999/test", "slalom-80/train", "bank.safetensors", "model.zip")


def deep(n, value=None):
    """A list in a list, and so on."""
    for _ in range(n):
        value = [value]
    return value


NESTED = ([], {}, [[]], [1, "a"], {"a": None}, {"": []}, {3: 4}, {None: 1}, [None], [0] * 10_000, deep(50), [[1], [2]])
numbers = st.sampled_from(NUMBERS) | st.integers() | st.floats()
texts = st.sampled_from(WORDS) | st.text(st.characters(), max_size=20)
hostile = numbers | texts | st.sampled_from(NESTED) | st.sampled_from(NUMBERS + WORDS)


def word(value):
    """A value as a word of a command line, which has no NUL, and bytes for lone surrogates."""
    if isinstance(value, (list, dict)):
        text = repr(value)
        with contextlib.suppress(TypeError):
            text = json.dumps(value)
    else:
        text = value if isinstance(value, str) else "null" if value is None else str(value)
        text = text.lower() if isinstance(value, bool) else text
    return os.fsdecode(text.replace("\0", "").encode("utf-8", "surrogateescape" if _escaped(text) else "replace"))


def _escaped(text):
    return all(not "\ud800" <= one <= "\udfff" or "\udc80" <= one <= "\udcff" for one in text)


def shown(value):
    """A value in a few words."""
    text = repr(value) if not isinstance(value, torch.Tensor) else f"tensor{list(value.shape)} {value.dtype}"
    return text if len(text) < 90 else f"{text[:60]}... of {len(text)}"


# -- what is done ----------------------------------------------------------------------------------------------------


def command(*words, spoil=lambda folder: None, told="", works=False):
    """A command as a process of its own would be."""

    def act():
        subprocess.Popen = warm.Popen
        sys.argv = ["uavnav", *words]
        end_quietly("uavnav")
        return main(words)

    told = " ".join(
        filter(None, [told, "uavnav", *(shlex.quote(one) if len(one) < 90 else shown(one) for one in words)])
    )
    return Case(told, act, spoil, works)


def call(told, function, *given, spoil=lambda folder: None, works=False, **named):
    """A call of the library; what it is allowed to raise is a refusal."""

    def act():
        end_quietly("uavnav")
        try:
            function(*given, **named)
        except Interrupted as stop:
            print(stop, file=sys.stderr)
            return 128 + stop.signum
        except TYPED as error:
            print(f"{type(error).__name__}: {error}" if len(str(error)) > 240 else error, file=sys.stderr)
            return 2

    values = ", ".join([*map(shown, given), *(f"{key}={shown(value)}" for key, value in named.items())])
    return Case(f"{told}({values})", act, spoil, works)


# -- settings --------------------------------------------------------------------------------------------------------


@functools.cache
def keys(algorithm, task):
    """Every key of a run's command line."""
    own = [item.name for item in dataclasses.fields(ALGORITHMS[algorithm].config) if item.name not in PARTS]
    parts = [f"{part}.{item.name}" for part, kind in parts_of(task).items() for item in dataclasses.fields(kind)]
    return [*own, *parts, *PARTS, *(line.name for line in of_command())]


@st.composite
def settings(draw):
    algorithm = draw(st.sampled_from(sorted(ALGORITHMS)))
    task = draw(st.sampled_from(["drone", "drone", *sorted(TASKS)]))
    chosen = draw(st.lists(st.sampled_from(keys(algorithm, task)), min_size=1, max_size=3, unique=True))
    given = {key: draw(hostile) for key in chosen}
    base = SMALL | OWN.get(algorithm, {}) | {"task": task}
    if draw(st.booleans()):
        base |= {"out": "new", "evaluate": False}
        flags = draw(st.sampled_from([[], [], ["-m"], ["--cfg", "job"], ["--json"]]))
        words = [word(f"{key}={word(value)}") for key, value in (base | given).items()]
        return command("train", algorithm, *words, *flags)
    nested = {key: value for key, value in (base | given).items() if key.partition(".")[0] not in PARTS}
    for key, value in given.items():
        part, _, name = key.partition(".")
        if part in PARTS:
            nested[part] = {name: value} if name else value
    if draw(st.booleans()):
        return call(f"{algorithm} in {task}: from_mapping", lambda **given: _config(algorithm, nested), **given)
    return call(f"{algorithm} in {task}: train", lambda **given: _train(algorithm, nested), **given)


def _config(algorithm, mapping):
    return ALGORITHMS[algorithm].config.from_mapping(mapping)


def _train(algorithm, mapping):
    ppo.train(_config(algorithm, mapping), out="new", quiet=True)


# -- command lines ---------------------------------------------------------------------------------------------------


@functools.cache
def options(name):
    """What a command takes."""
    parser = Parser(prog=f"uavnav {name}", add_help=False)
    commands.PARSERS[name](parser)
    return parser._actions


def arguments(action, draw):
    """Words for an option: wrong in kind or number, or such as it takes."""
    good = [word(value) for value in (*(action.choices or ()), *GIVEN.get(action.metavar, ()))]
    value = st.sampled_from(good) | hostile if good else hostile
    several = action.nargs in ("+", "*") or not draw(st.integers(0, 5))
    n = 0 if action.nargs == 0 else draw(st.integers(0, 3)) if several else 1
    given = [word(draw(value)) for _ in range(n)]
    if action.option_strings and len(given) == 1 and draw(st.booleans()):
        return [f"{action.option_strings[0]}={given[0]}"]
    return [*action.option_strings[:1], *given]


@st.composite
def command_lines(draw):
    name = draw(st.sampled_from([*commands.PARSERS, "train"]))
    if name == "train":
        flags = ["-m", "--multirun", "--cfg", "-c", "--quiet", "--json", "--help", "ppo", "dqn", "lr=1", "job"]
        words = draw(st.lists(st.sampled_from(flags) | hostile.map(word), max_size=4))
        return command("train", *words, *(["total_frames=64", "evaluate=false", "compile=off"] * draw(st.booleans())))
    actions = options(name)
    chosen = draw(st.lists(st.sampled_from(actions), min_size=1, max_size=3, unique_by=id))
    words = [one for action in chosen for one in arguments(action, draw)]
    for action in actions:
        if not action.option_strings and action not in chosen and action.nargs != "*":
            words = [draw(st.sampled_from(GIVEN.get(action.metavar, ("run",)))), *words]
    named = {option for action in chosen for option in action.option_strings}
    quick = QUICK.get(name, [])
    if name == "study":
        words = [*words, *quick[1:]]
    else:
        pairs = [quick[i : i + 2] for i in range(0, len(quick), 2)]
        words += [one for pair in pairs if pair[0] not in named for one in pair]
    stray = draw(st.lists(hostile.map(word), max_size=1)) if not draw(st.integers(0, 4)) else []
    if name == "bench":  # which would take 40 minutes
        return Case(f"uavnav bench {shown(words)}", lambda: commands.parse("bench", words) and 0)
    return command(name, *words, *stray, works=True)


# -- the library -----------------------------------------------------------------------------------------------------

TENSORS = (torch.zeros(0), torch.zeros(2, 0, 3), torch.full((2, 4, 3), math.nan), torch.ones(2, 4, 3, dtype=torch.long))
TENSORS += (
    torch.zeros(3),
    torch.full((1, 1, 3), 1e30),
    torch.zeros(1).expand(2**40),
    np.zeros((2, 4, 3)),
    b"x",
    Path(),
)
strange = hostile | st.sampled_from(TENSORS) | st.sampled_from([object, print, lambda *given, **named: None])


def _fly(env, **how):
    """Some steps of whatever kind of environment."""
    env.reset(**{"seed": 0} | {key: value for key, value in how.items() if key in ("seed", "options")})
    for _ in range(2):
        env.step(how["action"] if "action" in how else env.action_space.sample())
    env.close()


def _one(action=0, seed=0, options=None, **how):
    _fly(gymnasium.make("uavnav/Drone-v0", **how), action=action, seed=seed, options=options)


def _many(num_envs=2, actions=(0, 0), seed=0, options=None, **how):
    _fly(gymnasium.make_vec("uavnav/Drone-v0", num_envs, **how), action=actions, seed=seed, options=options)


def _world(task="drone", **fields):
    make_task("train", TASKS[task].WORLD(**fields), None, None, task)


def _reset(layout=0, **options):
    _one(options={"layout": layout, **options})


def _env(batch_size=(2,), **how):
    uavnav.DroneEnv(batch_size, **how).rollout(3)


def _evaluate(policy=uavnav.baselines.straight_ahead, **how):
    evaluate.evaluate_policy(policy, **{"episodes": 2, "max_steps": 5} | how)


def _evaluate_run(run="run", **how):
    evaluate.evaluate_run(Run(run), **{"episodes": 2, "max_steps": 5, "quiet": True} | how)


def _generate(n=2, k=4, seed=0, **how):
    layouts.generate(n, k, seed, **how)


def _save(bank=None, path="new.safetensors", seed=0, split="train"):
    layouts.save(layouts.generate(2, 4, seed=0) if bank is None else bank, path, seed=seed, split=split)


def _load_policy(run="run", **how):
    uavnav.load_policy(run, **how).values(torch.zeros(1, 30))


def _train_small(**how):
    ppo.train(ppo.PPOConfig(**SMALL | OWN["ppo"]), **{"out": "new", "quiet": True, "processes": 1} | how)


def _takes(function, *more):
    """The names of a function's arguments, those behind **how aside, which are given."""
    kinds = inspect.signature(function).parameters.values()
    return [one.name for one in kinds if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)] + list(more)


def _fields(kind):
    return [item.name for item in dataclasses.fields(kind)]


OF_ENVS = [name for name in _takes(uavnav.DroneEnv.__init__) if name not in ("self", "batch_size", "device")]
CALLS = [
    (_one, _takes(_one, *(name for name in OF_ENVS if name != "seeds"), "render_mode", *_fields(uavnav.World))),
    (_many, _takes(_many, *(name for name in OF_ENVS if name != "seeds"))),
    (_reset, ["layout", "heading"]),
    (_env, ["batch_size", *OF_ENVS]),
    *((functools.partial(_world, task), _fields(TASKS[task].WORLD)) for task in TASKS),
    (Faults, _fields(Faults)),
    (_evaluate, _takes(evaluate.evaluate_policy)),
    (_evaluate_run, _takes(evaluate.evaluate_run)),
    (_generate, _takes(layouts.generate)),
    (_save, _takes(_save)),
    (layouts.load, ["layouts"]),
    (layouts.check, ["layouts"]),
    (_load_policy, _takes(uavnav.load_policy)),
    (Run, ["path"]),
    (_train_small, [name for name in _takes(ppo.train) if name != "config"]),
    (uavnav.compare.contend, ["names"]),
    (lambda run="run", frames=None: verify(Run(run), frames, True), ["run", "frames"]),
    (studies.read, ["name"]),
    (uavnav.networks.Activation, ["name"]),
    (lambda policy="run", path="policy.pt2": uavnav.export.export_policy(uavnav.load_policy(policy), path), ["path"]),
]
NAMED_AS_GIVEN = (layouts.load, layouts.check, Run, studies.read, uavnav.networks.Activation, uavnav.compare.contend)


@st.composite
def library(draw):
    function, names = draw(st.sampled_from(CALLS))
    chosen = draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
    given = {name: draw(strange) for name in chosen}
    told = getattr(function, "__qualname__", None) or f"World of {function.args[0]}"
    if function in NAMED_AS_GIVEN:
        return call(told, function, *given.values(), works=False)
    return call(told, function, **given, works=True)


# -- study files -----------------------------------------------------------------------------------------------------

PLAIN = {
    "what": "one cell",
    "settings": {"activation": ["tanh"], "n_seeds": 2, "evaluate": {"episodes": 2, "max_steps": 5}, **SMALL},
    "cells": [{"algorithm": "ppo", "hidden": [[4]], **OWN["ppo"]}],
}
FULL = {
    **PLAIN,
    "banks": [4],
    "scripts": "baselines",
    "cells": [{"algorithm": ["ppo", "a2c"], "folder": "rate-{lr}", "lr": [0.1, 0.2], "world.slots": "listed"}],
    "tune": {
        "trials": 2,
        "at_once": 1,
        "settings": {
            "activation": "tanh",
            "n_seeds": 2,
            "total_frames": 64,
            "evaluate": {"episodes": 2, "max_steps": 9},
        },
        "ranges": {"rate": {"low": 1e-5, "high": 1e-2, "log": True}, "width": [32, 64]},
        "space": {"ppo": {"lr": "rate", "hidden": "width"}, "a2c": {"lr": "rate"}},
    },
}
BOMB = "a: &a [x,x]\n" + "\n".join(
    f"{b}: &{b} [*{a},*{a},*{a}]" for a, b in zip("abcdefghijk", "bcdefghijkl", strict=True)
)
RAW = ("", "[", "cells", "cells: [", "\t- x", "a: b: c", "cells: &a [*a]", BOMB, "[" * 5000, "{a: " * 500, "- " * 5000)
RAW += (
    "!!python/object/apply:os.mkdir [x]",
    "cells: !!binary x",
    "? {a: 1}\n: 2",
    "cells: [{algorithm: ppo}]\0",
    "\ufeff",
)
RAW += ("cells: [" + "{algorithm: ppo}," * 20_000 + "]", "--- 1\n--- 2", "<<: 3", "2001-13-45: 1", "cells: {<<: [1]}")
RAW += ("x" * 3_000_000, "settings: {lr: [" + "1e-3," * 3000 + "]}\ncells: [{algorithm: ppo, folder: '{lr}'}]")


def places(node, path=()):
    """Every way into a nest of lists and mappings."""
    found = [path] if path else []
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return found + [place for key, value in entries for place in places(value, (*path, key))]


def replaced(node, path, value):
    """A copy with another value at the end of a way; the key itself where the way is none."""
    if not path:
        return value
    entries = node.items() if isinstance(node, dict) else enumerate(node)
    pairs = [(key, replaced(old, path[1:], value) if key == path[0] else old) for key, old in entries]
    return dict(pairs) if isinstance(node, dict) else [old for _, old in pairs]


def dumped(value):
    """As YAML, or as JSON where YAML has no words for it."""
    try:
        return yaml.safe_dump(value)
    except Exception:
        return repr(value)


@st.composite
def study_texts(draw):
    if not draw(st.integers(0, 4)):
        return draw(st.sampled_from(RAW) | st.text(max_size=60))
    said = draw(st.sampled_from([PLAIN, PLAIN, FULL]))
    for _ in range(draw(st.integers(1, 3))):
        way = draw(st.sampled_from(places(said) or [()]))
        said = replaced(said, way, draw(hostile))
        if isinstance(said, dict) and not draw(st.integers(0, 5)):
            said = said | {draw(texts): draw(hostile)}
    return dumped(said)


@st.composite
def study_files(draw):
    text = draw(study_texts())
    settings = draw(st.lists(st.sampled_from(list(commands.STUDY_KEYS)), max_size=1))
    settings = [key for key in settings if key not in ("engine",)] if draw(st.booleans()) else []
    words = [word(f"{key}={word(draw(hostile))}") for key in settings]
    status = ["--status"] * draw(st.integers(0, 1)) + ["--json"] * draw(st.integers(0, 1))
    bounds = ["out=new", "report=false", "jobs=1"]
    given = [one for one in bounds if not any(other.startswith(one.partition("=")[0] + "=") for other in words)]

    def spoil(folder):
        (folder / "mine.yaml").write_bytes(text.encode(errors="surrogatepass"))

    return command("study", "mine.yaml", *given, *words, *status, spoil=spoil, told=f"{shown(text)} |")


# -- damaged files ---------------------------------------------------------------------------------------------------

SAME = ["train", "ppo", *(word(f"{key}={word(value)}") for key, value in (SMALL | OWN["ppo"]).items())]
HALF = ["train", "dqn", *(word(f"{key}={word(value)}") for key, value in (SMALL | OWN["dqn"]).items())]
STUDY = ["study", "study.yaml", "out=study", "report=false", "jobs=1"]
READERS = {
    "run": [
        *([name, "run", *QUICK.get(name, [])] for name in ("evaluate", "render", "export", "verify", "runs", "play")),
        [*SAME, "out=run", "n_seeds=2", "evaluate=false"],
        ["compare", "run", "reactive"],
        ["report", "run", "--out", "report"],
        ["playground", "run"],
        ["evaluate", "run", "--transfer", "--episodes", "2", "--max-steps", "5"],
    ],
    "half": [[*HALF, "out=half", "evaluate=false"], ["runs", "half"], ["evaluate", "half"], ["report", "half"]],
    "study": [[*STUDY, "--status"], STUDY, [*STUDY, "--status", "--json"], ["runs", "study"], ["SHARE"]],
    "tuned": [["study", "tuned.yaml", "out=tuned", *words] for words in (["--status"], ["trials=2", "report=false"])],
    "bank.safetensors": [
        ["layouts", "--check", "bank.safetensors"],
        ["evaluate", "reactive", *QUICK["evaluate"], "--layouts", "bank.safetensors"],
        [*SAME, "out=new", "evaluate=false", "layouts=bank.safetensors"],
    ],
}
FLOWN = [["evaluate", "{}", *QUICK["evaluate"]], ["render", "{}", *QUICK["render"]]]
READERS |= {POLICY: FLOWN, "model.zip": FLOWN, "study.yaml": [[*STUDY, "--status"]]}
SEEDED = st.integers(0, 2**32)


def fifo(path):
    missing(path)
    os.mkfifo(path)


def zeros(path):
    missing(path)
    path.symlink_to("/dev/zero")


def flip(path, chance):
    content = bytearray(path.read_bytes())
    if content:
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    put(path, bytes(content))


def signed(path):
    """Give a snapshot the name that belongs to what it holds now, and tell it to those that name it."""
    stem = path.stem.rpartition("-")[0]
    path.rename(path.with_name(f"{stem}-{hashlib.sha256(path.read_bytes()).hexdigest()[:32]}{path.suffix}"))


def values(path, chance):
    """One value of a text, or of the header of tensors, is another."""
    other = chance.choice([*NUMBERS, *WORDS, *NESTED])
    if path.suffix == ".safetensors":
        return header(path, chance, other)
    if path.suffix == ".parquet":
        return rows(path, chance, other)
    try:
        said = yaml.safe_load(path.read_text())
        text = replaced(said, chance.choice(places(said)), other)
        return put(
            path, (json.dumps(text) if path.suffix in (".json", ".job") else dumped(text)).encode(errors="replace")
        )
    except (yaml.YAMLError, UnicodeDecodeError, IndexError, TypeError):
        return lines(path, chance, other)


def lines(path, chance, other):
    """A line of a journal is another."""
    there = path.read_bytes().splitlines()
    if there:
        there[chance.randrange(len(there))] = word(other).encode(errors="replace")
    put(path, b"\n".join(there))


def header(path, chance, other):
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    said = json.loads(content[8 : 8 + size])
    inner = {key: json.loads(value) for key, value in said.get("__metadata__", {}).items() if value[:1] in "{["}
    key = chance.choice([*inner, None]) if inner else None
    if key is not None and places(inner[key]):
        said["__metadata__"][key] = json.dumps(replaced(inner[key], chance.choice(places(inner[key])), other))
    else:
        said = replaced(said, chance.choice(places(said)), other if chance.random() < 0.5 else word(other))
    text = json.dumps(said).encode()
    told = chance.choice([len(text), len(text), len(text), 0, 2**63, size + 1])
    put(path, told.to_bytes(8, "little") + text + content[8 + size :])


def rows(path, chance, other):
    table = pd.read_parquet(path)
    change = chance.choice(["rename", "words", "none", "value", "many", "more"])
    column = chance.choice(list(table))
    with contextlib.suppress(Exception):  # not every value fits into every column
        if change == "rename":
            table = table.rename(columns={column: word(other)})
        elif change == "words":
            table[column] = table[column].astype(str)
        elif change == "none":
            table = table[:0]
        elif change == "value":
            table.loc[0, column] = np.array(other).astype(table[column].dtype)
        elif change == "more":
            table[word(other)[:100]] = 0
        else:
            import pyarrow as pa
            import pyarrow.parquet as pq

            with pq.ParquetWriter(path, pa.table({name: pa.array([0]) for name in table}).schema) as writer:
                million = pa.table({name: pa.array(np.zeros(2**20, dtype=int)) for name in table})
                for _ in range(64):
                    writer.write_table(million)
            return
        table.to_parquet(path)


DAMAGES = {
    "missing": lambda path, chance: missing(path),
    "empty": lambda path, chance: put(path, b""),
    "cut": lambda path, chance: cut(chance.random())(path),
    "flipped": flip,
    "doubled": lambda path, chance: put(path, path.read_bytes() * 2),
    "a pipe": lambda path, chance: fifo(path),
    "endless": lambda path, chance: zeros(path),
    "a folder": lambda path, chance: a_folder(path),
    "a link to itself": lambda path, chance: itself(path),
    "text": lambda path, chance: put(path, chance.choice(RAW).encode(errors="surrogatepass")),
    **{f"another value {i}": values for i in range(6)},
}


@st.composite
def damaged(draw):
    part = draw(st.sampled_from([*READERS, "run", "half", "half", "study"]))
    seed, how = draw(SEEDED), draw(st.sampled_from(list(DAMAGES)))
    words = [one.replace("{}", part) for one in draw(st.sampled_from(READERS[part]))]

    def spoil(folder):
        chance = random.Random(seed)
        root = folder / part
        path = chance.choice(sorted(one for one in root.rglob("*") if one.is_file()) if root.is_dir() else [root])
        if words == ["SHARE"]:
            path = next(root.rglob("*.job"))
        DAMAGES[how](path, chance)
        sign = path.parent.name == "checkpoint" and path.is_file() and not path.is_symlink() and chance.random() < 0.7
        if sign and path.stem.startswith(("state-", "replay-")):
            signed(path)

    told = f"{part} (seed {seed}): {how} |"
    if words == ["SHARE"]:
        return Case(f"{told} uavnav.train.share", _share, spoil)
    return command(*words, spoil=spoil, told=told, works=words[0] == "play")


def _share():
    share.main([str(next(Path("study").rglob("*.job")))])


# -- planted faults, which a judge must see --------------------------------------------------------------------------


def _broken():
    raise KeyError("planted")


def _asleep():
    while True:
        with contextlib.suppress(KeyboardInterrupt):
            time.sleep(60)


def _hungry():
    torch.ones(2**30)


def _talking():
    print("x" * 301, file=sys.stderr)
    return 2


def _loud():
    print("two\nlines", file=sys.stderr)
    return 2


def _leaving():
    Path("run/meta.json").write_text("{}")
    print("refused", file=sys.stderr)
    return 2


PLANTED = {
    "traceback": [_broken, lambda: os.kill(os.getpid(), 11)],
    "hang": [_asleep],
    "memory": [_hungry],
    "long line": [_talking, _loud],
    "half-written": [_leaving, lambda: Path("run/.meta.json.1.aside").touch()],
}
planted = st.sampled_from([Case(name, act) for name, acts in PLANTED.items() for act in acts])

KINDS = {
    "settings": settings(),
    "command-lines": command_lines(),
    "library": library(),
    "study-files": study_files(),
    "files": damaged(),
    "planted": planted,
}
ATTACKED = tuple(KINDS)[:-1]


# -- the good files --------------------------------------------------------------------------------------------------


def warmed():
    """Import whatever a command imports."""
    for name in [*warm.MODULES, *map(module_of, commands.COMMANDS), *(one.module for one in ALGORITHMS.values())]:
        __import__(name)
    for name in ("optuna", "filelock", "uavnav.report.content", "uavnav.report.page", "uavnav.report.replays"):
        __import__(name)


def make_good(folder):
    """A bank, a finished and evaluated run, a half-finished one, one in two shares, a search, a policy, a zip."""
    layouts.save(layouts.generate(20, 4, seed=0), folder / "bank.safetensors", seed=0, split="train")
    run = ppo.train(ppo.PPOConfig(n_seeds=2, **SMALL | OWN["ppo"]), out="run", quiet=True)
    evaluate.evaluate_run(run, episodes=2, max_steps=5)
    for path in run.path.glob("*-test-2-5.parquet"):  # stands for 200 sets and 10,000 steps
        path.with_name(f"{path.name.partition('-')[0]}.parquet").write_bytes(path.read_bytes())
    with contextlib.suppress(Interrupted):
        dqn.train(dqn.DQNConfig(**SMALL | OWN["dqn"]), out="half", quiet=True, checkpoint_seconds=0, until=60)
    (folder / POLICY).write_bytes((run.path / POLICY).read_bytes())
    _make_zip(folder / "model.zip")
    _make_study(folder)
    _make_search(folder)


def _make_zip(path):
    from stable_baselines3 import PPO

    PPO("MlpPolicy", uavnav.gym.DroneGymEnv(), policy_kwargs={"net_arch": [8]}, device="cpu").save(path)


def _make_study(folder):
    """One whose only cell is half-finished, in two shares."""
    (folder / "study.yaml").write_text(yaml.safe_dump(PLAIN | {"settings": PLAIN["settings"] | {"total_frames": 256}}))
    (cell,) = studies.cells(studies.read("study.yaml"), folder / "study")
    with contextlib.suppress(Interrupted):
        ppo.train(cell.config, cell.out, quiet=True, checkpoint_seconds=0, processes=2, until=128)
    for path, config in shares.split(cell.config, cell.out, 2).items():
        described = shares.described(path, config, 60.0) | {"evaluation": cell.evaluation, "folder": "."}
        described["out"] = str(path.relative_to(folder))
        files.write(path.with_name(f"{path.name}.job"), json.dumps(described).encode())


def _make_search(folder):
    """One whose trials nobody trained."""
    searched = FULL | {"settings": PLAIN["settings"] | {"seed": 100}, "cells": PLAIN["cells"], "banks": []}
    (folder / "tuned.yaml").write_text(yaml.safe_dump(searched))
    found = search.plan(studies.read("tuned.yaml"), folder / "tuned")

    def train(cells):
        for cell in cells:
            cell.out.mkdir(parents=True, exist_ok=True)
            table = pd.DataFrame({"mode": ["greedy", "sampled"], "reward": [1.0, float(len(str(cell.config.lr)))]})
            table.to_parquet(cell.out / cell.flights[0])
        return []

    tuning.tune(found, train, say=lambda line: None)
