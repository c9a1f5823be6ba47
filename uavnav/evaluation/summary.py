"""The six metrics of a run or of an evaluation and the paper's: a table, and a record for JSON."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from uavnav.evaluation import scripted
from uavnav.runs import Run, metrics, paper
from uavnav.runs.definitions import ALL, LOG_CURVE, PER_FRAME, as_logged, decimals, per_frame
from uavnav.runs.lately import Lately, sparkline, with_spread
from uavnav.runs.metrics import METRICS, per_seed
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.protocol import MAX_STEPS, SPLITS
from uavnav.tasks.table import TASKS
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.training.config import TrainConfig

DEFINITIONS = {"world": ("slots", "padding", "start_heading"), "reward": ("eq14", "additive", "initial")}
"""Fields of the world that the paper does not fix, and rewards that its text allows."""


def _definitions(run: Run) -> dict[str, pd.DataFrame]:
    """A finished run per frame, by the log curve and per episode."""
    definitions = {PER_FRAME: per_frame(run.episodes, run.frames)}
    if (logged := as_logged(run.algorithm, run.config, run.episodes, run.frames)) is not None:
        definitions[LOG_CURVE] = logged
    return definitions | {ALL: per_seed(run.episodes)}


def _by_mode(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """An evaluation in each of its modes; rows: the columns of `metrics.EPISODE_COLUMNS` and `mode`."""
    return {mode: per_seed(rows[rows["mode"] == mode]) for mode in rows["mode"].unique()}


def of_run(run: Run) -> Table:
    """The six metrics of a finished run next to the paper's row."""
    config = run.config
    seeds = "1 seed" if config["n_seeds"] == 1 else f"{config['n_seeds']} seeds, mean ± standard deviation"
    environments = f"{config['n_envs']} parallel environment{'' if config['n_envs'] == 1 else 's'}"
    changes = [f"{name}={value}" for name, value in run.meta.get("beyond_preset", {}).items()]
    ends = "collision or goal" if config["task"] == "goal" else "collision"
    preset = " with ".join([f"preset {config['preset']}", *([", ".join(changes)] if changes else [])])
    return _metric_table(
        f"{run.algorithm} {config['activation']}, {preset}, {environments}",
        f"log curve and all training episodes leave open episodes out; judge by the test episodes.\n"
        f"{run.frames:,} frames per seed; {seeds}; {len(run.episodes):,} training episodes;"
        f" {run.meta['layouts']['k']} obstacles a layout; reward {config['reward']}; init {config['init']};"
        f" steps and distance {PER_FRAME} are per {ends}",
        _definitions(run),
        of_paper(run),
    )


def record(run: Run) -> dict[str, Any]:
    """What the tables of a finished run and of its evaluation show, for JSON."""
    rows, activation = run.evaluation(), run.config["activation"]
    facts = {"run": str(run.path), "algorithm": run.algorithm, "activation": activation, "frames": run.frames}
    definitions = _definitions(run) | ({} if rows is None else _by_mode(rows))
    return facts | {"seeds": run.seeds, "seconds": run.meta["wall_seconds"], "metrics": _numbers(definitions)}


def evaluation_record(rows: pd.DataFrame) -> dict[str, Any]:
    """What `of_evaluation` shows, for JSON."""
    seeds = sorted(map(int, rows["seed"].unique()))
    found: dict[str, Any] = {"seeds": seeds} | {str(name): said for name, said in rows.attrs.items()}
    found["metrics"] = _numbers(_by_mode(rows))
    own = {str(mode): metrics.own(part).mean().to_dict() for mode, part in rows.groupby("mode")}
    return found | ({"own": own} if any(own.values()) else {})


def _numbers(definitions: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Mean and standard deviation over seeds of each metric in each definition; null where there is none."""
    found: dict[str, Any] = {}
    for definition, seeds in definitions.items():
        known = {name: seeds[name].dropna().tolist() for name in METRICS}
        found[definition] = {
            name: {
                "mean": statistics.mean(values) if values else None,
                "sd": statistics.stdev(values) if len(values) > 1 else None,
            }
            for name, values in known.items()
        }
    return found


def _metric_table(
    title: str, caption: str, definitions: dict[str, pd.DataFrame], printed: dict[str, float], over: str = ""
) -> Table:
    """definitions: by name, a row a seed and a column a metric; over: what sums are divided by."""
    table = Table(title=title, caption=caption, min_width=79)
    table.add_column("metric")
    for definition in definitions:
        table.add_column(definition, justify="right")
    if printed:
        table.add_column("paper", justify="right")
    for name, metric in METRICS.items():
        configurations = [
            with_spread(seeds[name].dropna().tolist(), decimals(name, definition))
            for definition, seeds in definitions.items()
        ]
        beside = f"{printed[name]:,.{decimals(name, ALL)}f}" if name in printed else ""
        table.add_row(escape(metric.words(over)), *configurations, *([beside] if printed else []))
    return table


def of_paper(run: Run, header: Mapping[Any, Any] | None = None) -> dict[str, float]:
    """The paper's row for a run; nothing where its task or split, or those of its episodes, are other ones.

    What the paper leaves open may be read otherwise: `DEFINITIONS`. header: of a file of rows.
    """
    config, episodes = run.config, header or {}
    world = {name: value for name, value in config["world"].items() if name not in DEFINITIONS["world"]}
    other = config["task"] != "drone" or config.get("stack", 1) != 1
    other |= config["reward"] not in DEFINITIONS["reward"]
    other |= World().model_dump() | world != World().model_dump()
    other |= any(config.get("faults", {}).values()) or "faults" in episodes
    other |= not {config["layouts"], episodes.get("layouts", "test")} <= set(SPLITS)
    return {} if other else paper.TABLES.get((run.algorithm, run.config["activation"]), {})


def of_evaluation(rows: pd.DataFrame, who: str | Run) -> Table:
    """The six metrics of an evaluation in each of its modes, with the paper's row; who: acts."""
    modes = _by_mode(rows)
    censored = ", ".join(f"{rows.loc[rows['mode'] == mode, 'truncated'].mean():.0%} {mode}" for mode in modes)
    n_seeds, n_layouts = rows["seed"].nunique(), rows["layout"].nunique()
    seeds = "1 seed" if n_seeds == 1 else f"{n_seeds} seeds, mean ± standard deviation"
    name = f"{who.algorithm} {who.config['activation']}" if isinstance(who, Run) else who
    where = f"{name} on {n_layouts} {rows.attrs.get('layouts', 'test')} layouts"
    return _metric_table(
        ", ".join([where, *_how(rows.attrs, who)]),
        "; ".join([f"{seeds}; truncated at the time limit: {censored}", *_own(rows)]),
        modes,
        of_paper(who, rows.attrs) if isinstance(who, Run) else {},
        "episode",
    )


def _how(header: Mapping[Any, Any], who: str | Run) -> list[str]:
    """How a policy was evaluated, where that is not the usual way, by the header of its rows and who acts."""
    task = (who.config if isinstance(who, Run) else header).get("task", "drone")
    limit = header.get("max_steps", usual := TASKS.get(task, Task).limit(MAX_STEPS))
    told = [f"task {task}"] * (task != "drone") + [f"at most {limit:,} steps"] * (limit != usual)
    own = {"faults": "{}", "shield": "shielded", "at": "policies at {:g} of training"}
    return told + [text.format(header[name]) for name, text in own.items() if name in header]


def _own(rows: pd.DataFrame) -> list[str]:
    """What the task or the split has of its own, in words: means over seeds, by mode."""
    means = {str(mode): metrics.own(part).mean() for mode, part in rows.groupby("mode")}
    return [
        f"{escape(one.label)}: {', '.join(f'{mean[name]:,.2f} {mode}' for mode, mean in means.items())}"
        for name, one in metrics.OWN.items()
        if all(name in mean for mean in means.values())
    ]


def verdict(rows: pd.DataFrame, config: TrainConfig) -> str:
    """How a run flies that acts as in training, and `reactive` where that flies the same."""
    sampled, task = rows[rows["mode"] == "sampled"], TASKS[config.task]
    share, limit = sampled["truncated"].mean(), rows.attrs["max_steps"]
    ends = f"sampled, {share:.0%} of episodes reach the limit of {limit:,} steps"
    if "succeeded" in sampled:
        ends = f"sampled, {sampled['succeeded'].mean():.0%} of episodes reach the goal"
    usual = (config.world, config.reward, config.faults) == (task.WORLD(), task.REWARD, NO_FAULTS)
    beside = f", the scripted policy {scripted.REWARDS[config.task]:,.0f}"
    told = f"{ends}; reward {sampled['reward'].mean():,.0f}"
    return told + beside if usual and config.task in scripted.REWARDS else told


def report(run: Run) -> None:
    """Print the summary, what the seeds did last, how long the run took, and where it is."""
    show(of_run(run))
    lately = Lately(**run.meta["lately"])
    first = f" ({lately.curve[0]:,.1f} at first)" if lately.curve else ""
    if lately.flying:
        print(
            f"{sparkline(lately.curve)} in the last tenth, open episodes too: reward per 1,000 frames"
            f" {with_spread(lately.rewards, 1)}{first};\n"
            f"  no episode was terminated in {statistics.mean(lately.flying):.0%} of environments;"
            f" open ones are {statistics.mean(lately.lengths):,.0f} steps long so far"
        )
    print(f"{run.meta['wall_seconds']:.0f} s; the run is in {run.path}")


def show(table: Table) -> None:
    """Print a table, wider than the terminal rather than cut off; a closed pipe is met as by `print`."""
    console = Console()
    # the width that it has in a very wide terminal
    whole = console.measure(table, options=console.options.update(width=1000))
    console.width = max(console.width, whole.minimum)
    with console.capture() as text:
        console.print(table, crop=False)  # rich may take a column more than it measured
    print(text.get(), end="")
