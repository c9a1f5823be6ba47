"""The command `uavnav compare`: runs, policies, zips and baselines side by side, as text and as a small page.

What flies or loads a policy is imported where it is needed: rows of runs are compared without torch.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from uavnav import stats, style
from uavnav.errors import did_you_mean
from uavnav.report import charts, configurations, tables
from uavnav.report.configurations import MODE, Configuration
from uavnav.report.frames import Rows, columns
from uavnav.runs import POLICY, Run, read_settings, shipped
from uavnav.runs.evaluations import Protocol
from uavnav.runs.lately import sparkline
from uavnav.runs.metrics import EVALUATED, METRICS, own, per_seed
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.protocol import SCRIPTED
from uavnav.tasks.world import World

if TYPE_CHECKING:
    from uavnav.tasks.wrapper import WrappedTask

MARKS = (100, 1_000, 10_000)
"""Steps after which the episodes that go on are counted."""
SENSES = ("sensor_radius", "sensor_arc", "n_slots", "slots", "padding", "sense_velocity")
"""Fields of a `World` that are the drone's own: neither layouts nor rewards depend on them."""


class Contender(NamedTuple):
    """One of those that are compared."""

    name: str
    episodes: pd.DataFrame  # one row a test episode
    protocol: Mapping[str, Any]  # how they were evaluated
    place: Mapping[str, Any]  # and where: `task`, `reward`, fields of the world, and faults
    configuration: Configuration | None  # a run's training; None for what was not trained here
    pilot: str = ""  # an algorithm's or a scripted policy's name, for its colour

    @property
    def reward(self) -> tuple[stats.Interval, str]:
        """Of a test episode, and what the interval is over."""
        return of_episodes(self.episodes["reward"], self.episodes["seed"])


def contend(
    names: Sequence[str], activation: str | None = None, shield: bool = False, **asked: Any
) -> list[Contender]:
    """Read rows of runs, and of scripted policies in a `baselines/` above the first run; evaluate all else.

    activation: of a zip's hidden layers; shield: each is evaluated once more, under the shield; asked: the
    `episodes` or `max_steps` with which all are evaluated now.

    Raises:
        LayoutError, PolicyError, RunError: a name is none of a run, a policy file, a zip or a baseline.
    """
    runs = {name: _of_run(name, **asked) for name in names if name not in SCRIPTED and not _is_policy(name)}
    protocol = next((one.protocol for one in runs.values()), Protocol(**asked).header())
    first = next(iter(runs), None)
    found = []
    for name in names:
        kept = runs.get(name) or _kept(name, protocol, first)
        found.append(kept or fly(name, protocol, activation, first))
        if shield:
            own = _of_run(name, shield=True, **asked) if name in runs else None
            found.append(own or fly(name, protocol, activation, first, shield=True))
    return found


def _scripted(run: str | None) -> WrappedTask:
    """What scripted policies fly: the paper's task, or that of a run of another one."""
    from uavnav import plugins
    from uavnav.tasks.table import EMPTY, TASKS, make_task

    path = Path(run or "") / "config.yaml"
    settings = read_settings(path) if run is not None and path.exists() else {}
    name = settings.get("task", "drone")
    if name not in TASKS:
        noted = read_settings(path.with_name("meta.json")).get("plugins", {})
        raise RunError(f"{path}: task={name}{plugins.missing(noted) or did_you_mean(name, TASKS)}")
    return make_task(
        EMPTY, settings.get("world"), settings.get("reward"), task=name, faults=settings.get("faults")
    )


def _kept(name: str, protocol: Mapping[str, Any], run: str | None) -> Contender | None:
    """A scripted policy with the episodes that a folder above a run keeps, if they are as asked, or None."""
    if name not in SCRIPTED or run is None or protocol != Protocol().header():
        return None
    path = Path(run).absolute() / "config.yaml"
    settings, world, faults = read_settings(path), World().model_dump(), NO_FAULTS.model_dump()
    usual = {"task": "drone", "reward": "eq14", "world": world, "faults": faults}
    if any(settings.get(name, value) != value for name, value in usual.items()):
        return None
    for file in (folder / "baselines" / f"{name}.parquet" for folder in path.parents):
        if file.exists():
            rows = read_table(file, EVALUATED, "evaluate it again")
            place = _place("drone", "eq14", world, faults)
            return Contender(name, rows, protocol, place, None, name)
    return None


def _place(task: str, reward: str, world: Mapping[str, Any], faults: Mapping[str, Any]) -> dict[str, Any]:
    own = {name: world[name] for name in world if name not in SENSES}
    return {"task": task, "reward": reward} | own | {f"faults.{name}": faults[name] for name in faults}


def _is_policy(name: str) -> bool:
    file = Path(name).suffix in (".zip", Path(POLICY).suffix) and not os.path.isdir(name)
    return file or shipped.is_shipped(name)


def _of_run(name: str, shield: bool = False, **asked: Any) -> Contender:
    try:
        run = Run(name)
    except RunError as error:
        raise RunError(f"{error}{shipped.instead(name)}") from error
    rows = None if shield or asked else run.evaluation()
    if rows is None:
        from uavnav.evaluation import evaluate_run

        rows = evaluate_run(run, shield=shield, **asked)
    found = trained(name, configurations.read(Path(name)), rows)
    return found._replace(name=f"{name}, shielded", configuration=None) if shield else found


def trained(name: str, configuration: Configuration, rows: pd.DataFrame | None) -> Contender:
    """A run with its sampled test episodes, if it has any, and how they were evaluated."""
    own = configuration.settings
    world, faults = (
        {key.removeprefix(part): value for key, value in own.items() if key.startswith(part)}
        for part in ("world.", "faults.")
    )
    place = _place(own["task"], own["reward"], world, faults)
    protocol: dict[Any, Any] = {}
    sampled = configurations.EMPTY
    if rows is not None:
        protocol = {key: rows.attrs.get(key, value) for key, value in Protocol().header().items()}
        sampled = rows[rows["mode"] == MODE].drop(columns="mode")
    return Contender(name, sampled, protocol, place, configuration, configuration.algorithm)


def fly(
    name: str, protocol: Mapping[str, Any], activation: str | None, run: str | None, shield: bool = False
) -> Contender:
    """The episodes of what is no run, evaluated now; run: in whose task a scripted policy flies."""
    from uavnav.evaluation import across, on
    from uavnav.tasks.table import name_of

    who = across.of_policy(name, activation).as_trained()._replace(shield=shield)
    task = on(who.task or _scripted(run), **protocol)
    rows = who.fly(task, f"on {protocol['layouts']}", quiet=False, measure=None).drop(columns="mode")
    place = _place(name_of(task), task.reward, task.world.model_dump(), task.faults.model_dump())
    return Contender(f"{name}, shielded" if shield else name, rows, protocol, place, None, who.kind)


def check(contenders: Sequence[Contender]) -> None:
    """Raise a RunError unless all were evaluated on the same layouts with the same time limit."""
    first = contenders[0]
    for other in contenders[1:]:
        if other.protocol != first.protocol:
            both = " and ".join(f"{one.name} on {evaluated_on([one])}" for one in (first, other))
            raise RunError(f"evaluated differently: {both}; --episodes and --max-steps evaluate all alike")


def apart(contenders: Sequence[Contender]) -> str:
    """Which two flew in different tasks, and how these differ, in one line; often empty."""
    first = contenders[0]
    for other in contenders[1:]:
        differ = [key for key in first.place if key in other.place and first.place[key] != other.place[key]]
        if differ:
            both = (
                f"{one.name} ({', '.join(f'{key}={one.place[key]}' for key in differ)})"
                for one in (first, other)
            )
            return f"{' and '.join(both)} flew in different tasks, so their rewards are not of one measure"
    return ""


def trainings(contenders: Sequence[Contender]) -> dict[str, Configuration]:
    """The configurations of those that were trained here, by name."""
    return {one.name: one.configuration for one in contenders if one.configuration is not None}


def seeds_of(contenders: Sequence[Contender]) -> dict[str, pd.DataFrame]:
    """The metrics of every seed, by contender."""
    return {one.name: per_seed(one.episodes).join(own(one.episodes)) for one in contenders}


@columns("name", "metric", "n", "mean", "low", "high")
def metrics(contenders: Sequence[Contender]) -> Rows:
    """Mean and 95 % interval over seeds of each metric."""
    for name, table in seeds_of(contenders).items():
        for metric in METRICS:
            found = stats.interval(table[metric].to_numpy())
            yield name, metric, found.n, *found[:3]


def of_episodes(values: pd.Series, seeds: pd.Series) -> tuple[stats.Interval, str]:
    """A mean of episodes with its 95 % interval over seeds, or over the episodes of one seed; and which."""
    means = values.groupby(seeds).mean()
    found, over = (means, "seeds") if len(means) > 1 else (values, "episodes")
    return stats.interval(found.to_numpy(np.float64)), over


def ahead(one: Contender, other: Contender) -> tuple[stats.Interval, str]:
    """How much more reward one earns than the other on the same layouts, and what its interval is over.

    Of several seeds each it is Welch's; else as of `of_episodes`, against the other's mean on each layout.
    """
    seeds = [each.episodes.groupby("seed")["reward"].mean().to_numpy() for each in (one, other)]
    if min(map(len, seeds)) > 1:
        return stats.difference(seeds[:1], seeds[1:]), "seeds"
    theirs = other.episodes.groupby("layout")["reward"].mean()
    gaps = (one.episodes["reward"] - one.episodes["layout"].map(theirs)).dropna()
    return of_episodes(gaps, one.episodes["seed"])


def pairs(contenders: Sequence[Contender]) -> tables.Rows:
    """Each pair: how much more reward one earns, and how probably its seed beats one of the other."""
    rows = [["", "against", "more reward", "over", "probability of more", "Holm's p"]]
    by_name = {one.name: one for one in contenders}
    for pair in improvement(contenders).to_dict("records"):
        a, b = by_name[pair["a"]], by_name[pair["b"]]
        if pair["n_a"] < 2 <= pair["n_b"]:
            a, b = b, a  # the interval is over the seeds of the one that has several
        more, over = ahead(a, b)
        known = min(pair["n_a"], pair["n_b"]) > 1
        probability = f"{pair['probability']:.2f}" if known else tables.NOTHING
        p = tables.number(pair["p_holm"], 3) if known else tables.NOTHING
        rows.append([a.name, b.name, rounded(more), f"{more.n} {over}", probability, p])
    return rows


def rounded(found: stats.Interval) -> str:
    """A reward with its interval; hundreds are whole."""
    return tables.with_interval(*found[:3], 0 if abs(found.value) >= 100 else 1)


def caution(contenders: Sequence[Contender]) -> str:
    """What runs of one seed do not show; empty where every run has several."""
    trained = [one for one in contenders if one.configuration is not None]
    if all(one.episodes["seed"].nunique() != 1 for one in trained):
        return ""
    return "One seed shows a run, not its settings: other seeds may earn far more or less. Try n_seeds=5."


def survival(contenders: Sequence[Contender]) -> dict[str, pd.Series[float]]:
    """The share of episodes that last longer, by steps."""
    return {
        one.name: stats.survival(one.episodes["steps"].to_numpy(), one.episodes["terminated"].to_numpy())
        for one in contenders
    }


def improvement(contenders: Sequence[Contender]) -> pd.DataFrame:
    """The probability, for each pair, that a seed of one has more reward than a seed of the other."""
    return stats.improvement(
        {name: table["reward"].to_numpy() for name, table in seeds_of(contenders).items()}
    )


def evaluated_on(contenders: Sequence[Contender]) -> str:
    """How all of them were evaluated."""
    episodes, layouts, limit = (contenders[0].protocol[key] for key in ("episodes", "layouts", "max_steps"))
    return f"{episodes} layouts ({layouts}), at most {limit:,} steps"


def _short(names: Sequence[str]) -> list[str]:
    """Names without the folders that all paths among them share; absolute and relative ones share none."""
    folders = [os.path.dirname(name) for name in names if "/" in name]
    alike = len(folders) > 1 and len({os.path.isabs(folder) for folder in folders}) == 1
    shared = f"{os.path.commonpath(folders)}/" if alike else ""
    return [name.removeprefix(shared) for name in names]


def text(contenders: Sequence[Contender], console: Console) -> None:
    """Print the tables, and each run's learning curve as bars."""
    rows = tables.side_by_side(seeds_of(contenders))
    table = Table(
        "",
        *_short(rows[0][1:]),
        title=f"Means and 95 % intervals over seeds, sampled; {evaluated_on(contenders)}",
        title_justify="left",
        box=None,
    )
    for row in rows[1:]:
        table.add_row(*row)
    console.print(table)
    up = Table(title="Episodes that last at least so many steps [%]", title_justify="left", box=None)
    up.add_column("")
    marks = [mark for mark in MARKS if mark <= contenders[0].protocol["max_steps"]]
    for mark in marks:
        up.add_column(f"{mark:,}", justify="right")
    for name, shares in survival(contenders).items():
        up.add_row(name, *(f"{100 * float(shares[shares.index < mark].iloc[-1]):.0f}" for mark in marks))
    if marks:
        console.print(up)
    for a, b, more, over, probability, p in pairs(contenders)[1:]:
        beats = f"; a seed of it has more with probability {probability}, p = {p} (Holm)"
        console.print(f"{a} minus {b}: {more} of reward, over {over}{beats * (p != tables.NOTHING)}")
    if told := caution(contenders):
        console.print(told)
    for name, one in trainings(contenders).items():
        line = charts.band(one.curve)["mean"]
        ends = f"{style.number(line.iloc[0])} to {style.number(line.iloc[-1])}"
        console.print(f"{name}: reward per frame in training {sparkline(line.fillna(0.0).tolist())} {ends}")


def page(contenders: Sequence[Contender]) -> bytes:
    """The same as one file of HTML, with figures, and episodes of one seed of each run."""
    from uavnav.report import templating
    from uavnav.views import replays

    learned = trainings(contenders)
    looks = style.of_pilots({one.name: one.pilot for one in contenders})
    shown = [
        replays.Trained(one.algorithm, f"({name})", one.runs, colour=looks[name][0])
        for name, one in learned.items()
    ]
    recorded = replays.record(shown, n_seeds=1)
    limit = contenders[0].protocol["max_steps"]
    figures = [
        templating.sized("survival", "", "", charts.survival, survival(contenders), limit, looks=looks)
    ]
    if learned:
        figures.append(templating.sized("curves", "", "", charts.curves, learned, {}, looks=looks))
    return templating.page(
        "compare.html",
        {},
        names=[one.name for one in contenders],
        evaluated_on=evaluated_on(contenders),
        apart=apart(contenders),
        caution=caution(contenders),
        tables={
            "Means over seeds, with their 95 % intervals": [
                list(row) for row in zip(*tables.side_by_side(seeds_of(contenders)), strict=True)
            ],
            "Reward of a test episode on the same layouts: the difference with its 95 % interval; by"
            " Mann-Whitney, Holm, how probably a seed has more than a seed of another": pairs(contenders),
        },
        figures=figures,
        pictures=templating.pictures(figures),
        recorded=recorded if recorded["configurations"] else None,
        left_out=recorded["left_out"],
    ).encode()
