"""The command line: every command with its arguments, known without torch, so that help comes at once.

To add a command, add it to `KINDS`, and write the module with a `main`.
"""

from __future__ import annotations

import argparse
import contextlib
import glob
import importlib
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import BY_DEFAULT, LONGER, OUT, SCRATCH
from uavnav.cli import help as texts
from uavnav.errors import OneLineError, Parser, choose_from, complain, did_you_mean, one_line, whole
from uavnav.tasks.protocol import (
    ACROSS_STEPS,
    DEFAULT_K,
    DRAWS,
    EPISODES,
    GROUPS,
    LADDER_NAMES,
    MAX_STEPS,
    SCRIPTED,
    SPLITS,
    TASK_NAMES,
)

RUN_COLUMNS = (
    "run",
    "algorithm",
    "activation",
    "task",
    "preset",
    "seeds",
    "frames",
    "status",
    "reward_sampled",
    "reward_greedy",
    "age",
)
"""What `uavnav runs` says of a run and sorts by; its table shows less."""


TRAINING = ("train", "study", "verify")
"""Commands in which a ValueError without a line for users is a bug, and keeps its traceback."""


def run(name: str, words: Sequence[str], **how: Any) -> int:
    """Carry a command out; returns its exit status, after one line on stderr where something is wrong.

    how: further arguments of the command's `main`, such as a recipe's `fit`.
    """
    arguments = parse(name, words)
    if name == "train" and "torch" not in sys.modules:
        _say_at_once(arguments)
    try:
        if names := getattr(arguments, "plugins", None):
            from uavnav import plugins  # brings torch

            plugins.load(names)
        return int(importlib.import_module(f"uavnav.cli.{name}").main(arguments, **how))
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except OneLineError as error:
        if error.status != 2:  # it was stopped
            print(error, file=sys.stderr)
        else:
            complain(name, error if name in TRAINING[:2] else _as_option(error))
        return error.status
    except OSError as error:
        complain(name, error)
    except (ValueError, MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "allocate memory" in str(error):  # as torch says it
            complain(name, f"the machine's memory is too small for this ({error})")
        elif isinstance(error, ValueError) and name not in TRAINING:
            complain(name, _as_option(error))
        else:
            raise
    return 2


def _say_at_once(given: argparse.Namespace) -> None:
    """The first line of training, before the imports that take seconds."""
    if not (given.quiet or given.json or given.help or given.cfg):
        # a preset may name an activation, which is not known yet
        who = " ".join([given.algorithm, ", ".join(names_in(given.settings, "activation"))]).strip()
        who += f", preset {', '.join(names_in(given.settings, 'preset') or [USUAL['preset']])}"
        try:
            print(f"{who}: loading torch …", flush=True)
        except BrokenPipeError:  # nobody reads on, and the run is trained all the same
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _as_option(error: Exception) -> str:
    return re.sub("^plugins=", "--plugins ", str(error)).replace("activation=...", "--activation")


def parse(name: str, words: Sequence[str]) -> argparse.Namespace:
    """The arguments of a command; wrong ones, and those that ask for help, end the process."""
    warnings.formatwarning = lambda message, *where, **more: f"uavnav {name}: {one_line(message)}\n"
    parser = Parser(
        prog=f"uavnav {name}",
        description=COMMANDS[name].what,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # a slip is no other word for an option
    )
    for word in words:
        if re.fullmatch(r"-[^=]*=--", word):  # argparse takes it for an empty list
            parser.error(f"{word}: give a value")
    COMMANDS[name].add_to(parser)
    if name == "train":
        return _settings(parser, words)
    found: argparse.Namespace = parser.parse_args(words)
    return found


def overview() -> str:
    """The commands by kind, each with what it does."""
    width = max(map(len, COMMANDS))
    lines = []
    for kind, (example, own) in KINDS.items():
        lines += [f"{kind}:", *(f"  {name:{width}}  {one.what}" for name, one in own.items())]
        lines += [f"  {'':{width}}    {example}", ""]
    return "\n".join(
        [*lines, "uavnav COMMAND --help says more of each; uavnav --version says which version this is."]
    )


# -- train ---------------------------------------------------------------------------------------------------

USUAL = {"preset": "paper", "activation": "tanh"}
"""What names the default folder of a run, where it is not given."""


def _settings(parser: Parser, words: Sequence[str]) -> argparse.Namespace:
    """An algorithm, settings and flags, in any order.

    The result has `algorithm`, `settings` (each key=value), `plugins`, `multirun`, `cfg`, `quiet`, `json` and
    `help`, which is true where plugins or a task's module must be asked.
    """
    asked = {"-h", "--help"}
    found, strange = parser.parse_known_intermixed_args([word for word in words if word not in asked])
    given = [*found.words, *(word for word in strange if not word.startswith("-"))]
    algorithm = next((word for word in given if "=" not in word), "")
    if algorithm:
        given.remove(algorithm)
    found.algorithm, found.settings, found.help = algorithm, given, not asked.isdisjoint(words)
    found.plugins = names_in(given, "plugins")
    if (found.help and not algorithm) or not words:
        parser.leave(_algorithms())
    if found.help and algorithm in ALGORITHMS and not found.plugins and not names_in(given, "task"):
        parser.leave(texts.text_of(algorithm).read_text(encoding="utf-8"))
    for word in strange:
        if word.startswith("-"):
            parser.refuse(_no_flag(word, algorithm, given, parser))
    if algorithm not in ALGORITHMS and not (algorithm and found.plugins):
        parser.refuse(f"algorithm={algorithm}; {choose_from(algorithm, ALGORITHMS)}{needs(algorithm, given)}")
    for word in given:
        if not re.match(r"\+*[^=+]+=", word):
            parser.refuse(f"{word!r} is no setting; settings are key=value: activation=tanh")
    return found


def names_in(settings: Sequence[str], key: str) -> list[str]:
    """The names in `key=name` or `key=[one,other]` among settings, which may begin with a +."""
    values = [word.partition("=")[2] for word in settings if word.lstrip("+").startswith(f"{key}=")]
    names = [name.strip() for value in values for name in value.strip("[]").split(",")]
    return [name for name in names if name and name != "null"]


def needs(algorithm: str, settings: Sequence[str]) -> str:
    """The end of a message: plugins that the run of a command line had and lacks now; often empty."""
    from uavnav.runs import default_folder, read_settings
    from uavnav.runs.tables import RunError

    given = {key: next(iter(names_in(settings, key)), usual) for key, usual in USUAL.items()}
    usual = default_folder(algorithm, **given, changes={})
    names = names_in(settings, "out") or sorted(map(str, usual.parent.glob(f"{glob.escape(usual.name)}*")))
    for name in names:
        with contextlib.suppress(RunError):
            if noted := read_settings(Path(name) / "meta.json").get("plugins"):
                from uavnav import plugins

                return plugins.missing(noted)
    return ""


def _no_flag(word: str, algorithm: str, settings: Sequence[str], parser: Parser) -> str:
    """What is said of a flag that is none: the nearest, and the setting that was meant."""
    flag, _, value = word.partition("=")
    key = flag.lstrip("-").replace("-", "_")
    path = texts.text_of(algorithm)
    there = algorithm in ALGORITHMS and path.is_file()
    keys = re.findall(r"^  (\w+)=", path.read_text(encoding="utf-8"), re.MULTILINE) if there else []
    meant = value or next((word for word in settings if "=" not in word), "...")
    example = f"{key}={meant}" if key in (*keys, "plugins") else "activation=tanh"
    near = did_you_mean(flag, parser.flags())
    return f"there is no flag {flag}{near}; settings are key=value: {example}"


def _algorithms() -> str:
    """The help of `uavnav train` without an algorithm: the algorithms, each with its first line."""
    width = max(map(len, ALGORITHMS))
    titles = {name: texts.text_of(name).read_text(encoding="utf-8").splitlines()[2] for name in ALGORITHMS}
    each = "\n".join(f"  {name:{width}}  {title}" for name, title in titles.items())
    return f"""usage: uavnav train ALGORITHM [KEY=VALUE ...] [-m] [--cfg job] [--quiet] [--json]

{TRAIN.what}

{each}

uavnav train ALGORITHM --help says what each key means.
An algorithm of your own: plugins=my_module
"""


STUDY_KEYS = {
    "engine": "engine=local, ray or slurm, with keys of its own: jobs (at once); address; partition, time "
    "[minutes], memory [GB], cluster",
    "out": "out=DIR (default: runs/NAME)",
    "seeds": "seeds=N of each configuration",
    "frames": "frames=N of each seed",
    "trials": "trials=N of each algorithm where the study tunes, or draws where it draws",
    "algorithms": "algorithms=ppo,sac only",
    "seeds_per_worker": "seeds_per_worker=N of a job",
    "checkpoint_seconds": "checkpoint_seconds=60 between two snapshots",
    "policies": "policies=true trains again what has rows and no policy",
    "report": "report=false writes none",
    "plugins": "plugins=my_module",
}
"""What each key of a study means."""


# -- the arguments of each command ---------------------------------------------------------------------------


Option = tuple[tuple[str, ...], dict[str, Any]]
"""The names of an argument of a command, and how argparse takes it."""


class Usage(NamedTuple):
    """A command; of options in a list of their own at most one is given."""

    what: str
    example: str
    options: Sequence[Option | list[Option]]

    def add_to(self, parser: Parser) -> None:
        parser.epilog = f"example: uavnav {self.example}" if self.example else None
        for one in self.options:
            place = parser.add_mutually_exclusive_group() if isinstance(one, list) else parser
            for names, how in one if isinstance(one, list) else [one]:
                place.add_argument(*names, **how)


def _flag(name: str, told: str) -> Option:
    return (name,), {"action": "store_true", "help": told}


def _value(name: str, told: str | None = None, usual: Any = None, **how: Any) -> Option:
    """An argument with a value; usual: its default, whose type it has, and which its help names."""
    if usual is not None:
        kind = whole if isinstance(usual, int) else type(usual)
        told, how = f"{told} (default: {usual})", {"type": kind, "default": usual} | how
    return (name,), {"help": told, **how}


TASKS = ", ".join(TASK_NAMES)
RUN = f"a run's folder, a policy that ships (ppo-tanh), a Stable-Baselines3 .zip, or {', '.join(SCRIPTED)}"
NO_RUNS = "(default: runs if it has any, else the policies that ship)"
LADDERS = (*LADDER_NAMES, *GROUPS)
SECTIONS = (*BY_DEFAULT, *LONGER)
STUDIES = sorted(path.stem for path in (Path(__file__).parent.parent / "studies").glob("*.yaml"))
PAGE = "the page (default: runs/playground.html where runs is there, else {})"
SIZES = ", ".join(f"{split.n:,} {name}" for name, split in SPLITS.items())
SEEDS = ", ".join(f"{split.seed} {name}" for name, split in SPLITS.items())

ACTIVATION = _value("--activation", "of a .zip's hidden layers, where it does not say it itself")
SHIELD = "the nearest action that cannot collide in the next step"
WHICH_LAYOUTS = _value(
    "--layouts", f"{', '.join(SPLITS)}, a rung's such as density-12/test, or a path", "test"
)
WHICH_TASK = f"that scripted policies fly in: {TASKS} (default: that of the run, or drone)"
FAULTS = _value(
    "--faults",
    "fly with these faults, or with none, instead of those of training, such as noise=5,late=2",
    metavar="FAULT=NUMBER,...",
)
JSON = _flag("--json", "print the table as JSON, and nothing else")
PLUGINS = _value(
    "--plugins",
    "modules of your own that a run was made with; they are imported",
    type=lambda names: [name.strip() for name in names.split(",")],
    default=[],
    metavar="NAME,...",
)
EPISODE = (
    _value("--seed", "training seed (default: each run's first)", type=whole),
    _flag(
        "--greedy",
        "take the best action always, instead of acting as in training (sampled, or with the final epsilon)",
    ),
    ACTIVATION,
    WHICH_LAYOUTS,
    _value("--task", WHICH_TASK, default="drone"),
    _value("--layout", "index of the layout", 0),
    PLUGINS,
)
"""What every command that shows episodes asks: which seed, how, and where."""

TRAIN = Usage(
    "Train an algorithm to fly the drone and compare it with the paper.",
    "",
    [
        _value("words", nargs="*"),
        (("--multirun", "-m"), {"action": "store_true"}),
        (("--cfg", "-c"), {"choices": ["job"]}),
        *(_value(flag, action="store_true") for flag in ("--quiet", "--json")),
    ],
)
STUDY = Usage(
    "Train, evaluate and report the configurations of a study, on this machine or on a cluster.",
    "study paper engine=slurm seeds=40 out=/shared/paper",
    [
        _value("name", f"{', '.join(STUDIES)}, or a yaml file of your own", metavar="NAME"),
        _value("settings", "; ".join(STUDY_KEYS.values()), nargs="*", default=[], metavar="KEY=VALUE"),
        _flag("--status", "say which configurations are finished, under way, missing"),
        _flag("--json", "the status as JSON"),
        _flag("--quiet", "show no progress"),
    ],
)
RUNS = Usage(
    "List the runs of some folders: what each is, how far it is, and what it reached.",
    "runs results --sort reward_sampled",
    [
        _value(
            "folders", "of runs (default: runs if it is there, else results)", nargs="*", metavar="FOLDER"
        ),
        _value("--sort", f"by one of {', '.join(RUN_COLUMNS)}", choices=RUN_COLUMNS, metavar="COLUMN"),
        [
            _flag("--watch", "renew the list every 2 seconds, until Ctrl-C"),
            _flag("--json", "print all that is known as JSON, and nothing else"),
        ],
    ],
)
EVALUATE = Usage(
    "Evaluate runs, scripted policies or zips of Stable-Baselines3 on the test split: a row per episode.",
    "evaluate runs/ppo-paper/relu reactive --episodes 200",
    [
        _value("runs", RUN, nargs="+", metavar="RUN"),
        _value("--episodes", "layouts", EPISODES),
        _value(
            "--max-steps",
            f"time limit (default: {MAX_STEPS:,}, across ladders and tasks {ACROSS_STEPS:,}, or the"
            " task's own if less)",
            type=whole,
        ),
        WHICH_LAYOUTS,
        _value("--task", WHICH_TASK),
        FAULTS,
        _value(
            "--at",
            "fly the policies kept after this share of training, such as 0.1 (see the setting keep_at)",
            type=float,
            metavar="SHARE",
        ),
        [
            _value(
                "--across",
                f"evaluate on every rung of these instead: {', '.join(LADDERS)}",
                nargs="+",
                choices=LADDERS,
                metavar="LADDER",
            ),
            _flag(
                "--transfer",
                "evaluate each instead in every task that one of the runs was trained in,"
                " and draw the matrix",
            ),
        ],
        _flag("--alone", "with --across: only the runs, sampled, without scripted policies and a figure"),
        ACTIVATION,
        _flag("--shield", f"put all under the shield: {SHIELD}"),
        _flag(
            "--measures",
            "count danger, separation, curvature and jerk too; takes longer, for no step is skipped",
        ),
        _value("--seeds", f"so many seeds of {DRAWS}, each on every layout", 1, metavar="N"),
        _value(
            "--out",
            "keep rows of what is no run there; a report looks in its baselines/",
            type=Path,
            metavar="DIR",
        ),
        JSON,
        _flag("--quiet", "print nothing but errors"),
        PLUGINS,
    ],
)
PLAY = Usage(
    "Watch runs fly in the browser, or fly yourself: writes the playground and opens it.",
    "play runs/ppo-paper/relu reactive --layout 20",
    [
        _value("runs", f"a folder of runs, {RUN} {NO_RUNS}", nargs="*", metavar="RUN"),
        *EPISODE,
        _value("--max-steps", f"time limit (default: {MAX_STEPS:,}, or the task's own if less)", type=whole),
        _value("--out", PAGE.format("a temporary file"), type=Path, metavar="FILE"),
        _value(
            "--keep",
            "add the episodes in a file that K of the page saved to those that uavnav report runs shows",
            type=Path,
            metavar="FILE",
        ),
        _value("--person", "with --keep: who flew them, the rows' seed", 0),
    ],
)
PLAYGROUND = Usage(
    "Write playground.html: fly the drone in a browser, against trained policies and a scripted policy.",
    "playground runs --out playground.html",
    [
        _value(
            "folders", f"a run, or runs with policies below {NO_RUNS}", nargs="*", type=Path, metavar="FOLDER"
        ),
        _value("--out", PAGE.format("playground.html"), type=Path, metavar="FILE"),
        PLUGINS,
    ],
)
RENDER = Usage(
    "Draw episodes on the same obstacles, side by side, as MP4 or GIF, or their trails as PNG.",
    "render runs/ppo-paper/relu reactive --out episode.gif",
    [
        _value("runs", RUN, nargs="+", metavar="RUN"),
        _value("--out", "an .mp4, .gif or .png file", Path("episode.gif")),
        *EPISODE,
        FAULTS,
        _value("--steps", "steps at most", 500),
        _value("--every", "steps from one picture to the next", 1),
        _value("--speed", "times as fast as in the window", 1, type=float),
        _value(
            "--width",
            "width of one episode [px] (default: 480); an MP4 is padded to even sizes",
            type=whole,
            default=480,
        ),
    ],
)
COMPARE = Usage(
    "Compare runs, zips of Stable-Baselines3 and scripted policies: intervals, probabilities, curves.",
    "compare runs/ppo-fast/relu runs/dqn-fast/relu reactive",
    [
        _value("runs", RUN, nargs="+", metavar="RUN"),
        _value("--episodes", f"layouts (default: those of the first run, or {EPISODES})", type=whole),
        _value("--max-steps", f"time limit (default: that of the first run, or {MAX_STEPS:,})", type=whole),
        ACTIVATION,
        _flag("--shield", f"add each under the shield: {SHIELD}"),
        _value("--out", "a page, compare.html", type=Path, metavar="FILE"),
        JSON,
        PLUGINS,
    ],
)
REPORT = Usage(
    "Write report.html: your runs against the scripted policy, or the paper's claims, figures, replays.",
    "report runs --watch",
    [
        _value(
            "folders", "of runs (default: runs, or results where there is none)", nargs="*", metavar="FOLDER"
        ),
        _value(
            "--out",
            "where the report goes (default: the first FOLDER; without one runs, or report where only"
            " results is there)",
            metavar="DIR",
        ),
        _flag("--watch", "renew the page while runs train, until Ctrl-C"),
        PLUGINS,
    ],
)
VERIFY = Usage(
    "Repeat a run from its config.yaml and say whether its rows and weights are the same, bit for bit.",
    "verify runs/ppo-paper/relu --frames 20000",
    [
        _value("run", "a finished run's folder", type=Path, metavar="RUN"),
        _value("--frames", "repeat only the first so many frames per seed", type=whole),
        PLUGINS,
    ],
)
BENCH = Usage(
    "Measure the environment, training and its peers on this machine, in more than an hour.",
    "bench --quick",
    [
        _flag("--quick", "a first impression, in 3 to 5 minutes"),
        _value(
            "--only",
            f"of {', '.join(SECTIONS)} (default: {', '.join(BY_DEFAULT)})",
            nargs="+",
            choices=SECTIONS,
            metavar="SECTION",
        ),
        _value("--out", f"the file (default: {OUT}; with --quick {SCRATCH / 'quick.md'})", type=Path),
    ],
)
EXPORT = Usage(
    "Write a trained policy as ONNX (.onnx) or for torch.export.load (.pt2).",
    "export runs/ppo-paper/relu --out policy.onnx",
    [
        _value("run", "a run's folder, its policy file, or a zip of Stable-Baselines3", metavar="RUN"),
        _value("--seed", "which training seed (default: the first)", type=whole),
        ACTIVATION,
        _value("--out", "policy.onnx or policy.pt2", required=True, metavar="FILE"),
        PLUGINS,
    ],
)
LAYOUTS = Usage(
    "Generate layout files, or check that files are what their headers say.",
    "layouts --split train --k 12",
    [
        _value("--out", "folder for the files", Path("layouts")),
        _value("--split", "which split to write", choices=[*SPLITS, "all"], default="all"),
        _value("--task", f"whose obstacles: {TASKS}", "drone"),
        _value(
            "--k", f"obstacles per layout, 0 for an empty arena (default: {DEFAULT_K}; in 3D 40)", type=whole
        ),
        _value("--n", f"layouts in the split (default: {SIZES})", type=whole),
        _value("--seed", f"generator seed (default: {SEEDS})", type=whole),
        _value("--check", "regenerate these from their headers and compare", nargs="+", metavar="FILE"),
    ],
)

KINDS: dict[str, tuple[str, dict[str, Usage]]] = {
    "Train": ("uavnav train ppo preset=fast out=runs/first", {"train": TRAIN, "study": STUDY, "runs": RUNS}),
    "Look": (
        "uavnav render reactive random --layout 20 --out episode.gif",
        {"evaluate": EVALUATE, "play": PLAY, "playground": PLAYGROUND, "render": RENDER},
    ),
    "Compare": (
        "uavnav compare runs/first reactive",
        {"compare": COMPARE, "report": REPORT, "verify": VERIFY, "bench": BENCH},
    ),
    "Share": ("uavnav export runs/first --out policy.pt2", {"export": EXPORT, "layouts": LAYOUTS}),
}
"""Commands by what one does with them, and an example."""
COMMANDS = {name: one for _, own in KINDS.values() for name, one in own.items()}
"""By name. The module of each is `uavnav.cli.<name>`."""
