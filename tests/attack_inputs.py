"""Hostile inputs by class, as strategies of Hypothesis: what `attack` tries, and the good files that it
begins with.
"""

import contextlib
import functools
import inspect
import json
import math
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
import warm
from hypothesis import strategies as st

import uavnav
from uavnav import evaluation, studies
from uavnav.__main__ import main
from uavnav.algorithms import ALGORITHMS, ppo
from uavnav.cli import commands
from uavnav.cli.terminal import end_quietly
from uavnav.cli.train import Command
from uavnav.envs.gym import DroneGymEnv
from uavnav.errors import Parser
from uavnav.evaluation.verify import verify
from uavnav.runs import POLICY, Run
from uavnav.runs.tables import RunError
from uavnav.tasks import layouts
from uavnav.tasks.faults import Faults
from uavnav.tasks.table import TASKS, make_task
from uavnav.training.config import PARTS, parts_of
from uavnav.training.recorder import Interrupted

TYPED = (ValueError, TypeError, RunError, gymnasium.error.Error)
"""What the library may raise; ConfigError, LayoutError and PolicyError are ValueErrors."""
SMALL = {"total_frames": 64, "n_envs": 2, "hidden": [4], "compile": "off"}
OWN = {
    "ppo": {"frames_per_batch": 64, "minibatch_size": 32, "epochs": 1},
    **{name: {"learning_starts": 16, "batch_size": 8, "buffer_size": 256} for name in ("dqn", "c51", "sac")},
}
QUICK = {
    "evaluate": ["--episodes", "2", "--max-steps", "5"],
    "render": ["--steps", "2", "--out", "episode.png"],
    "export": ["--out", "policy.pt2"],
    "layouts": ["--out", "layouts", "--n", "4", "--k", "4"],
    "study": ["study.yaml", "out=study", "report=false", "jobs=1"],
    "play": ["--out", "page.html"],
}
"""Words that keep a command short, unless the attack takes their place."""
GIVEN = {"RUN": ("run", "reactive", "model.zip", POLICY), "FOLDER": ("run", "."), "NAME": ("study.yaml",)}
"""Good words by the placeholder of a parser."""
TEXT_MOST = 100_000


class Case(NamedTuple):
    """How to spoil a folder, what to do there, and both in words; works: whether it may take for ever by
    itself.
    """

    told: str
    act: Callable[[], int | None]
    spoil: Callable[[Path], Any] = lambda folder: None
    works: bool = False


# -- hostile values ------------------------------------------------------------------------------------------

NUMBERS = (
    0,
    -1,
    1,
    2,
    3,
    7,
    0.5,
    -0.5,
    2**31 - 1,
    2**31,
    2**63 - 1,
    2**63,
    10**22,
    10**400,
    1e308,
    -1e308,
    5e-324,
)
NUMBERS += (math.inf, -math.inf, math.nan, True, False, None)
WORDS = (
    "",
    " ",
    "\0",
    "a\nb",
    "\x1b[2J",
    "\udc80",
    "\ud800",
    "x" * 300,
    "x" * 5000,
    "x" * TEXT_MOST,
    "y " * 9999,
)
WORDS += (
    "..",
    ".",
    "a/b",
    "run",
    "half",
    "nowhere",
    "{lr}",
    "{0.x}",
    "{lr.__class__}",
    "{:>999999999}",
    "%s%n",
    "*",
)
WORDS += (
    "${out}",
    "${oc.env:HOME}",
    "[",
    "[[1,2",
    "{a:",
    "a,b",
    "range(0,9)",
    "nan",
    "1e999",
    "null",
    "true",
    "0x1f",
)
WORDS += (
    "2001-13-45",
    "é" * 300,
    "-",
    "--",
    "-1",
    "!!python/object/apply:os.mkdir [x]",
    "1_0",
    "١٢",
    "1e3",
    "on",
)
WORDS += (
    "train",
    "test",
    "density-4/test",
    "density-999/test",
    "slalom-80/train",
    "own.safetensors",
    "model.zip",
)


def deep(n, value=None):
    """A list in a list, and so on."""
    for _ in range(n):
        value = [value]
    return value


NESTED = (
    [],
    {},
    [[]],
    [1, "a"],
    {"a": None},
    {"": []},
    {3: 4},
    {None: 1},
    [None],
    [0] * 10_000,
    deep(50),
    [[1], [2]],
)
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
    return os.fsdecode(
        text.replace("\0", "").encode("utf-8", "surrogateescape" if _escaped(text) else "replace")
    )


def _escaped(text):
    return all(not "\ud800" <= one <= "\udfff" or "\udc80" <= one <= "\udcff" for one in text)


def shown(value):
    """A value in a few words."""
    text = f"tensor{list(value.shape)} {value.dtype}" if isinstance(value, torch.Tensor) else repr(value)
    text = getattr(value, "__name__", text)  # of a function, whose address is another every time
    return text if len(text) < 90 else f"{text[:60]}... of {len(text)}"


# -- what is done --------------------------------------------------------------------------------------------


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
            return 0 if stop.wanted else stop.status  # `until` was asked for
        except TYPED as error:
            print(error, file=sys.stderr)
            return 2

    values = ", ".join([*map(shown, given), *(f"{key}={shown(value)}" for key, value in named.items())])
    return Case(f"{told}({values})", act, spoil, works)


# -- settings ------------------------------------------------------------------------------------------------


@functools.cache
def keys(algorithm, task):
    """Every key of a run's command line."""
    parts = [f"{part}.{name}" for part, kind in parts_of(task).items() for name in kind.names()]
    return [*ALGORITHMS[algorithm].config.model_fields, *parts, *Command.names()]


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
        return call(
            f"{algorithm} in {task}: from_mapping", lambda **given: _config(algorithm, nested), **given
        )
    return call(f"{algorithm} in {task}: train", lambda **given: _train(algorithm, nested), **given)


def _config(algorithm, mapping):
    return ALGORITHMS[algorithm].config.from_mapping(mapping)


def _train(algorithm, mapping):
    ppo.train(_config(algorithm, mapping), out="new", quiet=True)


# -- command lines -------------------------------------------------------------------------------------------


@functools.cache
def options(name):
    """What a command takes."""
    parser = Parser(prog=f"uavnav {name}", add_help=False)
    commands.COMMANDS[name].add_to(parser)
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
    name = draw(st.sampled_from([*commands.COMMANDS]))
    if name == "train":
        flags = [
            "-m",
            "--multirun",
            "--cfg",
            "-c",
            "--quiet",
            "--json",
            "--help",
            "ppo",
            "dqn",
            "lr=1",
            "job",
        ]
        words = draw(st.lists(st.sampled_from(flags) | hostile.map(word), max_size=4))
        return command(
            "train", *words, *(["total_frames=64", "evaluate=false", "compile=off"] * draw(st.booleans()))
        )
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


# -- the library ---------------------------------------------------------------------------------------------

TENSORS = (
    torch.zeros(0),
    torch.zeros(2, 0, 3),
    torch.full((2, 4, 3), math.nan),
    torch.ones(2, 4, 3, dtype=torch.long),
)
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
    evaluation.evaluate_policy(policy, **{"episodes": 2, "max_steps": 5} | how)


def _evaluate_run(run="run", **how):
    evaluation.evaluate_run(Run(run), **{"episodes": 2, "max_steps": 5, "quiet": True} | how)


def _generate(n=2, k=4, seed=0, **how):
    layouts.generate(n, k, seed, **how)


def _save(obstacles=None, path="new.safetensors", seed=0, split="train"):
    layouts.save(
        layouts.generate(2, 4, seed=0) if obstacles is None else obstacles, path, seed=seed, split=split
    )


def _load_policy(run="run", **how):
    uavnav.load_policy(run, **how).values(torch.zeros(1, 30))


def _train_small(**how):
    ppo.train(ppo.PPOConfig(**SMALL | OWN["ppo"]), **{"out": "new", "quiet": True, "processes": 1} | how)


def _takes(function, *more):
    """The names of a function's arguments, those behind **how aside, which are given."""
    kinds = inspect.signature(function).parameters.values()
    return [one.name for one in kinds if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)] + list(more)


OF_ENVS = [name for name in _takes(uavnav.DroneEnv.__init__) if name not in ("self", "batch_size", "device")]
CALLS = [
    (_one, _takes(_one, *(name for name in OF_ENVS if name != "seeds"), *uavnav.World.names())),
    (DroneGymEnv, ["render_mode"]),  # of which gymnasium.make has an opinion of its own
    (_many, _takes(_many, *(name for name in OF_ENVS if name != "seeds"))),
    (_reset, ["layout", "heading"]),
    (_env, ["batch_size", *OF_ENVS]),
    *((functools.partial(_world, task), TASKS[task].WORLD.names()) for task in TASKS),
    (Faults, Faults.names()),
    (_evaluate, _takes(evaluation.evaluate_policy)),
    (_evaluate_run, _takes(evaluation.evaluate_run)),
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
    (
        lambda policy="run", path="policy.pt2": uavnav.export.export_policy(uavnav.load_policy(policy), path),
        ["path"],
    ),
]
NAMED_AS_GIVEN = (
    layouts.load,
    layouts.check,
    Run,
    studies.read,
    uavnav.networks.Activation,
    uavnav.compare.contend,
)


@st.composite
def library(draw):
    function, names = draw(st.sampled_from(CALLS))
    chosen = draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
    given = {name: draw(strange) for name in chosen}
    told = getattr(function, "__qualname__", None) or f"World of {function.args[0]}"
    if function in NAMED_AS_GIVEN:
        return call(told, function, *given.values(), works=False)
    return call(told, function, **given, works=True)


# -- planted faults, which a judge must see ------------------------------------------------------------------


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
planted = st.sampled_from(
    [Case(f"{name}, {number}", act) for name, acts in PLANTED.items() for number, act in enumerate(acts)]
)
