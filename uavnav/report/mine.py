"""My runs, finished or not: those that name no study, ranked with the scripted policy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav import style
from uavnav.errors import OneLineError
from uavnav.report import charts, compare, tables, templating
from uavnav.report.compare import Contender, ahead
from uavnav.report.configurations import EMPTY, Configuration, settings_of, show
from uavnav.report.frames import REACTIVE, least_to_most
from uavnav.report.templating import Figure, sized
from uavnav.report.verdicts import SEEDS
from uavnav.runs import FINISHED, WORKERS, Run, heard, paper, progress, read_settings, run_folders
from uavnav.runs.evaluations import Protocol, usual
from uavnav.runs.metrics import EPISODE_COLUMNS, EVALUATED
from uavnav.runs.metrics import of_episodes as measures
from uavnav.runs.tables import RunError, read_table, write_table
from uavnav.settings import differing
from uavnav.tasks.protocol import MAX_STEPS
from uavnav.training.checkpoints import Checkpoints
from uavnav.views import replays

YOU = "you"
"""Who flew by hand: `uavnav play --keep`."""
SHOWN = {"success": "reach the goal [%]", "survive": "reach the time limit [%]"}
"""The ranking's second number: the first of these that the episodes have."""
Looks = Mapping[str, tuple[str, str]]
"""A colour and a line by the name of a run."""
Begun = tuple[Configuration, str]
"""A run, and how far it is."""


class Group(NamedTuple):
    """Runs whose rewards are of one measure."""

    title: str
    how: str  # they were evaluated
    contenders: list[Contender]  # the best first, those without test episodes last
    scripted: Contender | None
    ranking: tables.Rows
    figures: list[Figure]


KIND = "algorithm", "preset", "task"
NOT_SAID = "total_frames", "layouts"


class Mine(NamedTuple):
    """All that a report says of one's own runs."""

    groups: list[Group]
    best: str  # in a sentence
    differ: tables.Rows
    claims: str  # what the verdicts of the paper's claims would need, empty where they can be judged
    recorded: dict[str, Any] | None
    left_out: list[str]

    @property
    def figures(self) -> list[Figure]:
        """Of all groups."""
        return [figure for group in self.groups for figure in group.figures]


def gather(
    found: Sequence[Configuration],
    unfinished: Mapping[Path, Begun],
    folders: Sequence[Path],
    out: Path,
    tell: Callable[[str], None],
) -> Mine | None:
    """What is said of the runs without a study; None where all of them have one.

    found: finished ones of all kinds; unfinished: as the function of that name gives them; out: where
    scripted episodes are kept; tell: as of `report`.
    """
    own: dict[Path, Begun] = {
        one.runs[0].path: (one, f"{least_to_most([one.n_seeds], 'seed')}, {one.settings['frames']:,} frames")
        for one in found
        if not one.study
    }
    own |= unfinished
    if not own:
        return None
    paths, contenders = {}, []
    status = {YOU: "by hand"}
    for name, (path, (one, how)) in zip(_names([*own], folders), own.items(), strict=True):
        if len(one.runs) > 1:  # runs that differ in their seeds are one
            name = f"{name} and {len(one.runs) - 1} more"
        paths[name], status[name] = path, how
        first, rows = one.runs[0].evaluation() if one.runs else None, None
        if first is not None:
            rows = one.evaluation.copy()
            rows.attrs = first.attrs
        contenders.append(compare.trained(name, one, rows))
    tell("ranking runs against the scripted policy")
    looks = style.of_pilots({one.name: one.pilot for one in contenders} | {YOU: YOU})
    groups: list[Group] = []
    damaged: list[str] = []
    for place, members in enumerate(_alike(contenders)):
        run, there = paths[members[0].name], [*folders, out]
        beyond = {key.partition(".")[0] for key in read_settings(run / "meta.json").get("beyond_preset", {})}
        plain = not {"world", "reward", "faults"} & beyond
        scripted = _scripted(members[0], run, plain, there, damaged)
        people = _by_hand(members[0], there, damaged) if plain else []
        groups.append(_group([*members, *people], scripted, status, looks, place))
    tell("flying a typical episode of each run")
    recorded, left_out = _typical(contenders, looks)
    return Mine(
        groups,
        _best(groups, paths),
        differences(contenders),
        _missing(found, folders[0]),
        recorded,
        [*left_out, *dict.fromkeys(damaged)],
    )


def unfinished(folders: Sequence[Path]) -> dict[Path, Begun]:
    """The runs that are training or were stopped and name no study, by their folders."""
    found = {}
    for path in dict.fromkeys(path for folder in folders for path in run_folders(folder)[0]):
        try:
            meta = read_settings(path / "meta.json")
            if meta.get("status") == FINISHED or meta.get("study"):
                continue
            config = read_settings(path / "config.yaml")
        except RunError:  # no run's, as `collect` says
            continue
        found[path] = _begun(path, config, meta)
    return found


def _begun(path: Path, config: Mapping[str, Any], meta: Mapping[str, Any]) -> Begun:
    """An unfinished run as far as it is, and how far that is: its snapshots' episodes."""
    told = progress(path)
    frames, episodes = _snapshots(path)
    frames, total = max(frames, told.get("frames", 0)), config["total_frames"]
    run = heard(told, time.time()) and meta.get("status") == "running"
    status = f"{'running' if run else 'stopped'} at {frames:,} of {total:,} frames"
    settings = settings_of(config, meta, max(frames, 1))
    algorithm, activation = config["algorithm"], config["activation"]
    return Configuration(algorithm, activation, settings, [], episodes, EMPTY), status


def _snapshots(path: Path) -> tuple[int, pd.DataFrame]:
    """The frames and the episodes of a run so far: of its newest snapshots, and of workers that have
    finished.
    """
    parts, frames = [], []
    for folder in [path, *sorted((path / WORKERS).glob("*"))]:
        try:
            if read_settings(folder / "meta.json").get("status") == FINISHED:
                run = Run(folder)
                rows, reached = run.episodes, run.frames
            else:
                newest = Checkpoints(folder / "checkpoint", {}).newest()
                columns = {name: newest.state["episodes"][name].numpy() for name in EPISODE_COLUMNS}
                rows, reached = pd.DataFrame(columns).astype(EPISODE_COLUMNS), newest.frames
        except (RunError, KeyError):
            continue
        parts.append(rows)
        frames.append(reached)
    return min(frames, default=0), pd.concat(parts, ignore_index=True) if parts else EMPTY


def _names(paths: Sequence[Path], folders: Sequence[Path]) -> list[str]:
    """Names of runs: their paths below the report's folders, whole where two would be the same."""
    short = []
    for path in paths:
        folder = next(one for one in folders if path.is_relative_to(one))
        name = str(path.relative_to(folder)) if path != folder else path.name
        short.append(f"./{name}" if name in (YOU, REACTIVE) else name)
    return [name if short.count(name) == 1 else str(path) for name, path in zip(short, paths, strict=True)]


def _alike(contenders: Sequence[Contender]) -> list[list[Contender]]:
    """Those that flew in one task by one protocol together; those that did not fly, with their task's."""
    groups: list[list[Contender]] = []
    for one in sorted(contenders, key=lambda one: not one.protocol):
        for members in groups:
            first = members[0]
            if first.place == one.place and (not one.protocol or first.protocol == one.protocol):
                members.append(one)
                break
        else:
            groups.append([one])
    return groups


def _group(
    members: Sequence[Contender],
    scripted: Contender | None,
    status: Mapping[str, str],
    looks: Looks,
    place: int,
) -> Group:
    """The ranking and the figures of runs in one task; place: of the group, for the names of its files."""
    evaluated = sorted((one for one in members if len(one.episodes)), key=lambda one: -one.reward[0].value)
    ordered = [*evaluated, *(one for one in members if not len(one.episodes))]
    rows = {}
    for one in evaluated:
        rewards = one.episodes["reward"]
        seeds = rewards.groupby(one.episodes["seed"]).mean()
        dots = seeds if len(seeds) > 1 else rewards  # a number a seed, or an episode of a single seed
        rows[one.name] = dots.to_numpy(np.float64), one.reward[0]
    reward = earned = np.nan
    if scripted is not None:
        reward, sums = scripted.reward[0].value, scripted.episodes[["reward", "steps"]].sum()
        earned = sums["reward"] / sums["steps"]
    learned, task = compare.trainings(members), str(members[0].place["task"])
    figures = []
    if rows:
        name, axis = f"ranking-{place + 1}", "reward of a test episode"
        words = "A small dot is a seed, or an episode where there is one seed; a large one is the mean."
        figures.append(sized(name, "runs", words, charts.episodes, rows, looks, reward, axis))
    if any(len(one.episodes) for one in learned.values()):
        words = (
            "Reward per frame in training, in stretches of each run's frames so far; band: 95 % over seeds."
        )
        name = f"curves-{place + 1}"
        figures.append(sized(name, "runs", words, charts.curves, learned, {}, looks=looks, scripted=earned))
    how = compare.evaluated_on(ordered) if evaluated else "no test episodes yet"
    return Group(
        replays.TITLES.get(task, task).capitalize(),
        how,
        ordered,
        scripted,
        _ranking(ordered, scripted, status),
        figures,
    )


def _kept(folders: Sequence[Path], name: str, damaged: list[str]) -> pd.DataFrame | None:
    """The rows of the first file of a name in the folders' `baselines` that can be read, if there is one;
    what is wrong with others is added to `damaged`.
    """
    for path in (folder / "baselines" / name for folder in folders):
        try:
            if path.exists():
                return read_table(path, EVALUATED, "delete it")
        except RunError as error:
            damaged.append(str(error))
    return None


def _scripted(
    first: Contender, run: Path, plain: bool, folders: Sequence[Path], damaged: list[str]
) -> Contender | None:
    """The scripted policy's episodes on a run's layouts, kept or new; None where it cannot.

    plain: the run's task is as its name has it, so that episodes are kept for others.
    """
    protocol, task = first.protocol or usual(str(first.place["task"])).header(), str(first.place["task"])
    layouts, episodes, limit = (protocol[key] for key in ("layouts", "episodes", "max_steps"))
    name = Protocol(layouts, episodes, limit, None, task).file(REACTIVE)
    if plain and (rows := _kept(folders, name, damaged)) is not None:
        return Contender(REACTIVE, rows, protocol, first.place, None, REACTIVE)
    try:
        evaluated = compare.fly(REACTIVE, protocol, None, str(run))
    except (OneLineError, ValueError, OSError):
        return None
    if plain:
        rows, path = evaluated.episodes.copy(), folders[-1] / "baselines" / name
        rows.attrs = {str(key): value for key, value in protocol.items()}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_table(path, rows)
        except (RunError, OSError) as error:
            damaged.append(str(error))
    return evaluated


def _by_hand(first: Contender, folders: Sequence[Path], damaged: list[str]) -> list[Contender]:
    """What people flew in the paper's task, if the first of the runs flew there; none elsewhere."""
    as_kept = {"layouts": "test", "max_steps": MAX_STEPS}
    if first.place["task"] != "drone" or not as_kept.items() <= first.protocol.items():
        return []
    rows = _kept(folders, "human.parquet", damaged)
    return [] if rows is None else [Contender(YOU, rows, first.protocol, first.place, None, YOU)]


def _ranking(
    ordered: Sequence[Contender], scripted: Contender | None, status: Mapping[str, str]
) -> tables.Rows:
    """A row a run and one for the scripted policy, the best first; those without test episodes last."""
    shown = [one for one in (*ordered, scripted) if one is not None and len(one.episodes)]
    shown.sort(key=lambda one: -one.reward[0].value)
    own = {one.name: measures(one.episodes).mean() for one in shown}
    column = next((name for name in SHOWN if any(name in one for one in own.values())), "survive")
    rows = [["run", "reward an episode", "over", SHOWN[column], "minus the scripted policy", "training"]]
    for one in shown:
        mean, over = one.reward
        numbers = compare.rounded(mean), f"{mean.n} {over}", f"{own[one.name][column]:.0f}"
        if one is scripted:
            rows.append([f"scripted policy, `{REACTIVE}`", *numbers, tables.NOTHING, "none"])
        else:
            gap = compare.rounded(ahead(one, scripted)[0]) if scripted is not None else tables.NOTHING
            rows.append([one.name, *numbers, gap, status[one.name]])
    late = [one for one in ordered if not len(one.episodes)]
    return rows + [[one.name, "not evaluated", *[tables.NOTHING] * 3, status[one.name]] for one in late]


def _best(groups: Sequence[Group], paths: Mapping[str, Path]) -> str:
    """The best run of the first group, and the scripted policy; where there are others, which group it is."""
    first = groups[0]
    best = next(one for one in first.contenders if one.pilot != YOU)
    if best.configuration is not None and not best.configuration.runs:
        return "No run has finished yet."
    if not len(best.episodes):
        return f"No run has been evaluated yet: `uavnav evaluate {paths[best.name]}`."
    mean, over = best.reward
    which = f" ({first.title})" if len(groups) > 1 else ""
    said = f"Of your runs{which}, **{best.name}** earns most: {compare.rounded(mean)} of reward an episode"
    said += f" (95 % interval over {over})."
    if first.scripted is not None:
        said += f" The scripted policy earns {compare.rounded(first.scripted.reward[0])}."
    return f"{said} {compare.caution([one for one in first.contenders if len(one.episodes)])}".strip()


def differences(contenders: Sequence[Contender]) -> tables.Rows:
    """What every run was trained with, and how it differs from its preset or from peers of its `KIND`."""
    named = ["algorithm", "activation", "preset", "task", "frames", "n_envs"]
    trained = compare.trainings(contenders)
    known = {
        name: {"algorithm": one.algorithm, "activation": one.activation} | one.settings
        for name, one in trained.items()
    }
    rows = [["run", *named, "and else"]]
    for name, own in known.items():
        kind = [own.get(key) for key in KIND]
        peers = [other for other in known.values() if [other.get(key) for key in KIND] == kind]
        beyond = {key for run in trained[name].runs for key in run.meta["beyond_preset"]} - {"layouts"}
        differ = beyond | (differing(peers) & own.keys())
        told = (f"{key}={show(own.get(key))}" for key in sorted(differ.difference(named, NOT_SAID)))
        rows.append([name, *(show(own.get(key)) for key in named), ", ".join(told) or tables.NOTHING])
    return rows


def _missing(found: Sequence[Configuration], folder: Path) -> str:
    """What the paper's claims would need, in a sentence; empty where there is enough to judge some."""
    ready = {
        (one.algorithm, one.activation)
        for one in found
        if one.n_seeds >= SEEDS and one.settings["task"] == "drone"
    } & paper.TABLES.keys()
    if len(ready) > 1 or any(one.study for one in found):
        return ""
    return (
        f"The verdicts on the paper's claims need at least two of its {len(paper.TABLES)} configurations with"
        f" {SEEDS} seeds each; here {len(ready)} {'has' if len(ready) == 1 else 'have'} that many."
        f" `uavnav study paper out={folder}` trains all of them."
    )


def _typical(contenders: Sequence[Contender], looks: Looks) -> tuple[dict[str, Any] | None, list[str]]:
    """The replay of each run's median episode by reward; its first one where it was not evaluated."""
    shown = []
    for one in contenders:
        if one.configuration is not None and (runs := one.configuration.runs):
            seed, layout = typical(one.episodes) if len(one.episodes) else (None, 0)
            colour = looks[one.name][0]
            shown.append(replays.Trained(one.pilot, f"({one.name})", runs, seed, [layout], colour))
    recorded = replays.record(shown, n_seeds=1, n_layouts=1)
    return recorded if recorded["configurations"] else None, recorded["left_out"]


def typical(episodes: pd.DataFrame) -> tuple[int, int]:
    """Seed and layout of the median episode by reward, of two the lesser."""
    ordered = episodes.sort_values(["reward", "seed", "layout"])
    middle = ordered.iloc[(len(ordered) - 1) // 2]
    return int(middle["seed"]), int(middle["layout"])


def contents(mine: Mine, left_out: Sequence[str], watched: bool) -> dict[str, bytes]:
    """The files of a report on only one's own runs; left_out: a line for each run that is not in it."""
    told: dict[str, Any] = {
        "mine": mine,
        "pictures": templating.pictures(mine.figures),
        "left_out": left_out,
        "watched": watched,
    }
    return templating.files_of(mine.figures) | {
        "report.html": templating.page("mine.html", {}, **told).encode(),
        "report.md": templating.TEMPLATES.get_template("runs.md").render(told).encode(),
    }
