"""The command line: every command with its arguments, known without torch, so that help and mistakes come at
once.

`run` parses the words of a command, calls `main` of its module, and says in one line what went wrong. To add
a command, add its function to `KINDS`, and write the module with a `main`.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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
    SCRIPTS,
    SPLITS,
    TASK_NAMES,
)

TASKS = ", ".join(TASK_NAMES)

RUN = f"a run's folder, a policy that ships (ppo-tanh), a Stable-Baselines3 .zip, or {', '.join(SCRIPTS)}"
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


TRAIN = ("train", "study", "verify")
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
        status: int = importlib.import_module(f"uavnav.cli.{name}").main(arguments, **how)
        return status
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except OneLineError as error:
        if error.status != 2:  # it was stopped
            print(error, file=sys.stderr)
        else:
            complain(name, error if name in TRAIN[:2] else _as_option(error))
        return error.status
    except OSError as error:
        complain(name, error)
    except (ValueError, MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "allocate memory" in str(error):  # as torch says it
            complain(name, f"the machine's memory is too small for this ({error})")
        elif isinstance(error, ValueError) and name not in TRAIN:
            complain(name, _as_option(error))
        else:
            raise
    return 2


def _say_at_once(given: argparse.Namespace) -> None:
    """The first line of training, before the imports that take seconds."""
    if not (given.quiet or given.json or given.help or given.cfg):
        preset, activation = (names_in(given.settings, key) or [USUAL[key]] for key in USUAL)
        who = f"{given.algorithm} {', '.join(activation)}, preset {', '.join(preset)}"
        try:
            print(f"{who}: loading torch …", flush=True)
        except BrokenPipeError:  # nobody reads on, and the run is trained all the same
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _as_option(error: Exception) -> str:
    """An error's line as a command says it."""
    return re.sub("^plugins=", "--plugins ", str(error)).replace("activation=...", "--activation")


def parse(name: str, words: Sequence[str]) -> argparse.Namespace:
    """The arguments of a command; where they are wrong, or ask for help, the process ends with one line
    or the help.
    """
    warnings.formatwarning = lambda message, *where, **more: f"uavnav {name}: {one_line(message)}\n"
    parser = Parser(
        prog=f"uavnav {name}",
        description=COMMANDS[name].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # a slip is no other word for an option
    )
    for word in words:
        if re.fullmatch(r"-[^=]*=--", word):  # argparse takes it for an empty list
            parser.error(f"{word}: give a value")
    COMMANDS[name](parser)
    if name == "train":
        return _settings(parser, words)
    found: argparse.Namespace = parser.parse_args(words)
    return found


def overview() -> str:
    """The commands by kind, each with what it does."""
    width = max(map(len, COMMANDS))
    lines = []
    for kind, (example, own) in KINDS.items():
        lines += [f"{kind}:", *(f"  {name:{width}}  {add.__doc__}" for name, add in own.items())]
        lines += [f"  {'':{width}}    {example}", ""]
    return "\n".join(
        [*lines, "uavnav COMMAND --help says more of each; uavnav --version says which version this is."]
    )


# -- train ---------------------------------------------------------------------------------------------------

USUAL = {"preset": "vectorised", "activation": "tanh"}
"""What names the default folder of a run, where it is not given."""


def _train(parser: Parser) -> None:
    """Train an algorithm on the drone's world and compare it with the paper."""
    parser.add_argument("words", nargs="*")
    parser.add_argument("--multirun", "-m", action="store_true")
    parser.add_argument("--cfg", "-c", choices=["job"])
    for flag in ("--quiet", "--json"):
        parser.add_argument(flag, action="store_true")


def _settings(parser: Parser, words: Sequence[str]) -> argparse.Namespace:
    """An algorithm, settings and flags, in any order.

    The result has `algorithm`, `settings` (each key=value), `plugins`, `multirun`, `cfg`, `quiet`, `json` and
    `help`: that is true where plugins add to the choices, or a task has a world of its own, which only their
    modules know.
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
    """The names in `key=name` or `key=[one,other]` among the settings of a command line, which may begin
    with a +.
    """
    values = [word.partition("=")[2] for word in settings if word.lstrip("+").startswith(f"{key}=")]
    names = [name.strip() for value in values for name in value.strip("[]").split(",")]
    return [name for name in names if name and name != "null"]


def needs(algorithm: str, settings: Sequence[str]) -> str:
    """The end of a message: which plugins the run of a command line was begun with and lacks now; often
    empty.
    """
    from uavnav.runs import default_folder, read_settings
    from uavnav.runs.tables import RunError

    given = {key: next(iter(names_in(settings, key)), usual) for key, usual in USUAL.items()}
    usual = default_folder(algorithm, **given, changes={})
    names = names_in(settings, "out") or sorted(map(str, usual.parent.glob(f"{usual.name}*")))
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
    """The help of `uavnav train` alone: the algorithms, each with its first line."""
    width = max(map(len, ALGORITHMS))
    lines = [
        "usage: uavnav train ALGORITHM [KEY=VALUE ...] [-m] [--cfg job] [--quiet] [--json]",
        "",
        f"{_train.__doc__}",
        "",
    ]
    for name in ALGORITHMS:
        title = texts.text_of(name).read_text(encoding="utf-8").splitlines()[2]
        lines.append(f"  {name:{width}}  {title}")
    lines += [
        "",
        "uavnav train ALGORITHM --help says what each key means.",
        "An algorithm of your own: plugins=my_module",
    ]
    return "\n".join(lines) + "\n"


# -- the others ----------------------------------------------------------------------------------------------


def _evaluate(parser: Parser) -> None:
    """Fly runs, scripted policies or zips of Stable-Baselines3 on the test split: one row an episode."""
    parser.epilog = "example: uavnav evaluate runs/ppo-vectorised/relu reactive --episodes 200"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=RUN)
    parser.add_argument("--episodes", type=whole, default=EPISODES, help=f"layouts (default: {EPISODES})")
    told = (
        f"time limit (default: {MAX_STEPS:,}, across ladders and worlds {ACROSS_STEPS:,}, or the task's "
        "own if less)"
    )
    parser.add_argument("--max-steps", type=whole, help=told)
    _which_layouts(parser)
    _task(parser)
    _faults(parser)
    told = f"fly every rung of these instead: {', '.join((*LADDER_NAMES, *GROUPS))}"
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--across", nargs="+", choices=(*LADDER_NAMES, *GROUPS), metavar="LADDER", help=told)
    told = "with --across: no scripted policies beside, no greedy episodes, no figure"
    parser.add_argument("--alone", action="store_true", help=told)
    told = "fly each in every world that one of the runs was trained in instead, and draw the matrix"
    where.add_argument("--transfer", action="store_true", help=told)
    _activation(parser)
    _shield(parser, "fly all under the shield: the nearest action that cannot collide in the next step")
    told = "count danger, separation, curvature and jerk too; takes longer, for every step is flown"
    parser.add_argument("--measures", action="store_true", help=told)
    told = f"so many seeds of {DRAWS}, each on every layout (default: 1)"
    parser.add_argument("--seeds", type=whole, default=1, metavar="N", help=told)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="keep rows of what is no run there; a report looks in its baselines/",
    )
    _output(parser, "--json", "--quiet")
    _plugins(parser)


def _runs(parser: Parser) -> None:
    """List the runs of some folders: what each is, how far it is, and what it reached."""
    parser.epilog = "example: uavnav runs results --sort reward_sampled"
    parser.add_argument(
        "folders", nargs="*", metavar="FOLDER", help="of runs (default: runs if it is there, else results)"
    )
    parser.add_argument(
        "--sort", choices=RUN_COLUMNS, metavar="COLUMN", help=f"by one of {', '.join(RUN_COLUMNS)}"
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--watch", action="store_true", help="renew the list every 2 seconds, until Ctrl-C")
    how.add_argument("--json", action="store_true", help="print all that is known as JSON, and nothing else")


def _play(parser: Parser) -> None:
    """Watch runs fly in the browser, or fly yourself: writes the playground and opens it."""
    parser.epilog = "example: uavnav play runs/ppo-vectorised/relu reactive --layout 20"
    usual = "(default: runs if it has any, else the policies that ship)"
    parser.add_argument("runs", nargs="*", metavar="RUN", help=f"a folder of runs, {RUN} {usual}")
    _episode(parser)
    told = f"time limit (default: {MAX_STEPS:,}, or the task's own if less)"
    parser.add_argument("--max-steps", type=whole, help=told)
    parser.add_argument("--out", type=Path, metavar="FILE", help=_PAGE.format("a temporary file"))
    told = "add the episodes in a file that K of the page saved to those that uavnav report runs shows"
    parser.add_argument("--keep", type=Path, metavar="FILE", help=told)
    parser.add_argument(
        "--person", type=whole, default=0, help="with --keep: who flew them, the rows' seed (default: 0)"
    )


def _playground(parser: Parser) -> None:
    """Write playground.html: fly the drone in a browser, beside trained policies and a scripted policy."""
    parser.epilog = "example: uavnav playground runs --out playground.html"
    told = "a run, or runs with policies below (default: runs if it has any, else the policies that ship)"
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help=told)
    parser.add_argument("--out", type=Path, metavar="FILE", help=_PAGE.format("playground.html"))
    _plugins(parser)


_PAGE = "the page (default: runs/playground.html where runs is there, else {})"


def _render(parser: Parser) -> None:
    """Draw episodes on the same obstacles, side by side, as MP4 or GIF, or their trails as PNG."""
    parser.epilog = "example: uavnav render runs/ppo-vectorised/relu reactive --out flight.gif"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=RUN)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("flight.gif"),
        help="an .mp4, .gif or .png file (default: flight.gif)",
    )
    _episode(parser)
    _faults(parser)
    parser.add_argument("--steps", type=whole, default=500, help="steps at most (default: 500)")
    parser.add_argument(
        "--every", type=whole, default=1, help="steps from one picture to the next (default: 1)"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, help="times as fast as in the window (default: 1)"
    )
    parser.add_argument(
        "--width",
        type=whole,
        default=480,
        help="width of one episode [px] (default: 480); an MP4 is padded to even sizes",
    )


def _study(parser: Parser) -> None:
    """Train, evaluate and report the configurations of a study, on this machine or on a cluster."""
    studies = sorted(path.stem for path in (Path(__file__).parent.parent / "studies").glob("*.yaml"))
    parser.epilog = "example: uavnav study paper engine=slurm seeds=40 out=/shared/paper"
    parser.add_argument("name", metavar="NAME", help=f"{', '.join(studies)}, or a yaml file of your own")
    parser.add_argument(
        "settings", nargs="*", default=[], metavar="KEY=VALUE", help="; ".join(STUDY_KEYS.values())
    )
    parser.add_argument(
        "--status", action="store_true", help="say which configurations are finished, under way, missing"
    )
    parser.add_argument("--json", action="store_true", help="the status as JSON")
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _shield(parser: Parser, told: str) -> None:
    parser.add_argument("--shield", action="store_true", help=told)


def _compare(parser: Parser) -> None:
    """Compare runs, zips of Stable-Baselines3 and scripted policies: intervals, probabilities, curves."""
    parser.epilog = "example: uavnav compare runs/ppo-fast/relu runs/dqn-fast/relu reactive"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=RUN)
    _activation(parser)
    _shield(parser, "each under the shield too: the nearest action that cannot collide in the next step")
    parser.add_argument("--out", type=Path, metavar="FILE", help="a page, compare.html")
    _output(parser, "--json")
    _plugins(parser)


def _report(parser: Parser) -> None:
    """Write report.html: your runs beside the scripted policy, or the paper's claims, figures, replays."""
    parser.epilog = "example: uavnav report runs --watch"
    parser.add_argument(
        "folders", nargs="*", metavar="FOLDER", help="of runs (default: runs, or results where there is none)"
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="where the report goes (default: the first FOLDER; without one runs, or report where only"
        " results is there)",
    )
    parser.add_argument("--watch", action="store_true", help="renew the page while runs train, until Ctrl-C")
    _plugins(parser)


def _verify(parser: Parser) -> None:
    """Repeat a run from its config.yaml and say whether its rows and weights are the same, bit for bit."""
    parser.epilog = "example: uavnav verify runs/ppo-vectorised/relu --frames 20000"
    parser.add_argument("run", type=Path, metavar="RUN", help="a finished run's folder")
    parser.add_argument("--frames", type=whole, help="repeat only the first so many frames per seed")
    _plugins(parser)


def _bench(parser: Parser) -> None:
    """Measure the world, training and its peers on this machine, and write it down; 40 minutes."""
    parser.epilog = "example: uavnav bench --quick"
    parser.add_argument(
        "--quick", action="store_true", help="a first impression: 3 minutes, 5 if caches are cold"
    )
    sections = (*BY_DEFAULT, *LONGER)
    told = f"of {', '.join(sections)} (default: {', '.join(BY_DEFAULT)})"
    parser.add_argument("--only", nargs="+", choices=sections, metavar="SECTION", help=told)
    parser.add_argument(
        "--out", type=Path, help=f"the file (default: {OUT}; with --quick {SCRATCH / 'quick.md'})"
    )


def _export(parser: Parser) -> None:
    """Write a trained policy as ONNX (.onnx) or for torch.export.load (.pt2)."""
    parser.epilog = "example: uavnav export runs/ppo-vectorised/relu --out policy.onnx"
    parser.add_argument(
        "run", metavar="RUN", help="a run's folder, its policy file, or a zip of Stable-Baselines3"
    )
    parser.add_argument("--seed", type=whole, help="which training seed (default: the first)")
    _activation(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="policy.onnx or policy.pt2")
    _plugins(parser)


def _layouts(parser: Parser) -> None:
    """Generate layout files, or check that files are what their headers say."""
    sizes = ", ".join(f"{split.n:,} {name}" for name, split in SPLITS.items())
    seeds = ", ".join(f"{split.seed} {name}" for name, split in SPLITS.items())
    parser.epilog = "example: uavnav layouts --split train --k 12"
    parser.add_argument(
        "--out", type=Path, default=Path("layouts"), help="folder for the files (default: layouts)"
    )
    parser.add_argument("--split", choices=[*SPLITS, "all"], default="all", help="which split to write")
    parser.add_argument("--task", default="drone", help=f"whose obstacles: {TASKS} (default: drone)")
    parser.add_argument(
        "--k", type=whole, help=f"obstacles per set, 0 for an empty arena (default: {DEFAULT_K}; in 3D 40)"
    )
    parser.add_argument("--n", type=whole, help=f"layouts in the split (default: {sizes})")
    parser.add_argument("--seed", type=whole, help=f"generator seed (default: {seeds})")
    parser.add_argument(
        "--check", nargs="+", metavar="FILE", help="regenerate these from their headers and compare"
    )


STUDY_KEYS = {
    "engine": "engine=local, ray or slurm, with keys of its own: jobs (at once); address; partition, time "
    "[minutes],"
    " memory [GB], cluster",
    "out": "out=DIR (default: runs/NAME)",
    "seeds": "seeds=N of each configuration",
    "frames": "frames=N of each seed",
    "trials": "trials=N of each algorithm, where the study tunes",
    "algorithms": "algorithms=ppo,sac alone",
    "seeds_per_worker": "seeds_per_worker=N of a job",
    "checkpoint_seconds": "checkpoint_seconds=60 between two snapshots",
    "policies": "policies=true trains configurations again of which only rows are there",
    "report": "report=false writes none",
    "plugins": "plugins=my_module",
}
"""What each key of a study means."""


# -- what several have ---------------------------------------------------------------------------------------


def _episode(parser: Parser) -> None:
    """What every command that shows episodes asks: which seed, how, and where."""
    parser.add_argument("--seed", type=whole, help="training seed (default: each run's first)")
    greedy = (
        "take the best action always, instead of acting as in training (sampled, or with the final epsilon)"
    )
    parser.add_argument("--greedy", action="store_true", help=greedy)
    _activation(parser)
    _which_layouts(parser)
    _task(parser)
    parser.add_argument("--layout", type=whole, default=0, help="index of the layout (default: 0)")
    _plugins(parser)


def _which_layouts(parser: Parser) -> None:
    parser.add_argument(
        "--layouts",
        default="test",
        help=f"{', '.join(SPLITS)}, a rung's such as density-12/test, or a path (default: test)",
    )


def _task(parser: Parser) -> None:
    told = f"whose world scripted policies fly in: {TASKS} (default: that of the run, or drone)"
    parser.add_argument("--task", default="drone", help=told)


def _faults(parser: Parser) -> None:
    told = "fly with these faults, or with none, instead of those of training, such as noise=5,late=2"
    parser.add_argument("--faults", metavar="FAULT=NUMBER,...", help=told)


def _activation(parser: Parser) -> None:
    parser.add_argument("--activation", help="of a .zip's hidden layers, where it does not say it itself")


def _output(parser: Parser, *flags: str) -> None:
    says = {"--json": "print the table as JSON, and nothing else", "--quiet": "print nothing but errors"}
    for flag in flags:
        parser.add_argument(flag, action="store_true", help=says[flag])


def _plugins(parser: Parser) -> None:
    """`--plugins`, which `run` imports."""
    parser.add_argument(
        "--plugins",
        type=lambda names: [name.strip() for name in names.split(",")],
        default=[],
        metavar="NAME,...",
        help="modules of your own that a run was made with; they are imported",
    )


KINDS: dict[str, tuple[str, dict[str, Callable[[Parser], None]]]] = {
    "Train": (
        "uavnav train ppo preset=fast out=runs/first",
        {"train": _train, "study": _study, "runs": _runs},
    ),
    "Look": (
        "uavnav render reactive random --layout 20 --out flight.gif",
        {"evaluate": _evaluate, "play": _play, "playground": _playground, "render": _render},
    ),
    "Compare": (
        "uavnav compare runs/first reactive",
        {"compare": _compare, "report": _report, "verify": _verify, "bench": _bench},
    ),
    "Share": ("uavnav export runs/first --out policy.pt2", {"export": _export, "layouts": _layouts}),
}
"""Commands by what one does with them, with an example: the function that adds its arguments says what
each does.
"""
COMMANDS = {name: add for _, own in KINDS.values() for name, add in own.items()}
"""By name. The module of each is `uavnav.cli.<name>`."""
