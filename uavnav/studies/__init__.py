"""Studies: many configurations that are trained, evaluated and reported as one. A study is a yaml file here,
or one of yours.

    what: one line that says what it is
    obstacles: [4, 12]          # made first: layouts to train on with so many obstacles, in
                                # {out}/layouts/4/train.safetensors
    settings:                   # of every configuration, unless it says otherwise
      activation: [tanh, relu]  # a list stands for a configuration each, in all combinations
      n_seeds: 20               # any setting of an algorithm
      evaluate: {episodes: 10, max_steps: 500}  # by default 200 test layouts of 10,000 steps, or of the
                                # task's own time limit where that is lower; false: not at all; with
                                # `across: [density]` ladders too; `shield: true` is under the shield,
                                # `measures: true` counts more columns; a list stands for an evaluation each
      dqn: {learning_starts: 1000}              # of one algorithm's configurations
    configurations:
      - {algorithm: [ppo, dqn], folder: "rate-{lr}", lr: [1.0e-3, 1.0e-4]}   # in
                                # {out}/rate-0.001/ppo/tanh and so on
    scripted_folder: baselines  # scripted policies fly in the task of each configuration too, as it does;
                                # their rows go there
    scripted: [reactive, dwa]   # which of them; by default random, straight and reactive, which alone
                                # climb the ladders; ones that cannot fly a task are skipped
    tune: ...                   # settings that are searched for first: `search`
    draw: ...                   # settings that are drawn first: `draws`

`run` carries a study out, and `uavnav.cli.study` is its command.
"""

from __future__ import annotations

import itertools
import math
import os
import re
import string
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from uavnav import files
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, among, choose_from, one_line, told, unknown, unknown_key
from uavnav.evaluation import EPISODES, MAX_STEPS, MOST_STEPS, Protocol
from uavnav.settings import Whole, checked, shown
from uavnav.tasks import layouts
from uavnav.tasks.faults import from_words
from uavnav.tasks.layouts import LayoutError, judged_on
from uavnav.tasks.protocol import LADDER_NAMES, SCRIPTED, SPLITS, USUAL
from uavnav.tasks.table import TASKS
from uavnav.training.config import TrainConfig

HERE = Path(__file__).parent
KEYS = ("what", "obstacles", "settings", "configurations", "scripted_folder", "scripted", "tune", "draw")
OF_CONFIGURATIONS = ("folder", "algorithm", "evaluate")
"""Keys of a configuration that are no settings of its algorithm."""
LISTS = ("hidden", "keep_at")  # settings whose value is a list
MOST_CONFIGURATIONS = 10_000  # of a study, its trials included
MOST_EVALUATIONS = 100  # of a configuration
MOST_OBSTACLES = 1_000  # of a layout of a study's own splits
FORMAT = r"[,_]?0?\d{0,2}[,_]?(\.\d{1,2})?[defgs%]?"  # of a value in a folder's name
PATH = 1_000
"""Characters of a folder within a study's, at most; the operating system gives 255 bytes to each part."""
PROTOCOL = ("episodes", "max_steps", "layouts", "faults", "at", "shield")
"""Keys of `evaluate`, as `Protocol` has them; a list stands for an evaluation each."""


class Configuration(NamedTuple):
    """A run of a study."""

    config: TrainConfig
    out: Path
    evaluations: tuple[Protocol, ...] = ()  # first as the report shows it; nothing: not at all
    across: tuple[str, ...] = ()  # ladders that it flies too, with as many layouts and steps
    measures: bool = False  # whether rows of its evaluations have those columns of `evaluation.measures` too
    study: str = ""  # the name of its study, which its `meta.json` keeps

    @property
    def episodes(self) -> list[str]:
        """The files of rows and of behaviour that its first evaluation leaves; none where it has none."""
        return [one.file(name) for one in self.evaluations[:1] for name in ("evaluation", "behaviour")]


class Study(NamedTuple):
    """What a study file says."""

    name: str
    what: str
    obstacles: list[int]
    settings: Mapping[str, Any]
    configurations: Sequence[Mapping[str, Any]]
    tune: Mapping[str, Any] | None = None
    scripted_folder: str | None = None
    draw: Mapping[str, Any] | None = None
    scripted: Sequence[str] = USUAL
    given: Mapping[str, Any] = {}  # settings of every run of the study, instead of those of the file


def names() -> list[str]:
    """Of the studies that come with the package."""
    return sorted(path.stem for path in HERE.glob("*.yaml"))


def read(name: str, seeds: int | None = None, frames: int | None = None) -> Study:
    """A study of the package by its name, or of a file that ends in .yaml, with other numbers of seeds and
    frames where given; raises a ConfigError.
    """
    if not isinstance(name, str):
        raise ConfigError(f"name={told(name)}: there is no such study; {choose_from(name, names())}")
    path = Path(name) if name.endswith(".yaml") else HERE / f"{name}.yaml"
    if not os.path.lexists(path):
        raise ConfigError(
            f"{name}: there is no such study; {choose_from(name, names())}, or give a file of your own"
        )
    try:
        said = files.read_yaml(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error
    given = {key: value for key, value in (("n_seeds", seeds), ("total_frames", frames)) if value is not None}
    try:
        return _study(path.stem, said)._replace(given=given)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _study(name: str, said: Any) -> Study:
    entries = said.get("configurations") if isinstance(said, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ConfigError("is no study; give a list of `configurations`, as uavnav/studies/paper.yaml does")
    for key in said:
        if key not in KEYS:
            raise unknown_key(str(key), KEYS)
    obstacles = said.get("obstacles", [])
    known = isinstance(obstacles, list) and all(type(k) is int for k in obstacles)
    if not known or not all(0 <= k <= MOST_OBSTACLES for k in obstacles):
        raise ConfigError(f"obstacles={obstacles}; give a list of numbers of obstacles, such as [4, 12]")
    for entry in entries:
        if not isinstance(entry, dict) or "algorithm" not in entry:
            raise ConfigError(f"{entry}: is no configuration; it needs at least an `algorithm`")
        algorithms(entry)  # which raises
    settings, home = said.get("settings", {}), said.get("scripted_folder")
    for part in (settings, *entries):
        check_settings("settings", part)
    for key, example in (("tune", "tuning"), ("draw", "ambiguities")):
        if said.get(key) is not None and not isinstance(said[key], dict):
            raise ConfigError(
                f"{key}={said[key]}; give keys and values, as uavnav/studies/{example}.yaml does"
            )
    if home is not None:
        below = isinstance(home, str) and not os.path.isabs(home) and ".." not in Path(home).parts
        if not below or not _is_folder(home):
            raise ConfigError(f"scripted_folder={home}; give a folder's name, such as baselines")
    named = said.get("scripted", USUAL)
    if not isinstance(named, list | tuple) or not all(among(one, SCRIPTED) for one in named):
        raise ConfigError(f"scripted={told(named)}; give a list of some of {', '.join(SCRIPTED)}")
    if "scripted" in said and (home is None or not named):
        raise ConfigError(f"scripted={told(named)}; name at least one, and give a scripted_folder too")
    what, tune, draw = one_line(said.get("what", name)), said.get("tune"), said.get("draw")
    return Study(name, what, [*dict.fromkeys(obstacles)], settings, entries, tune, home, draw, named)


def only(study: Study, chosen: str | None) -> Study:
    """The same with the configurations of some algorithms, their names between commas."""
    if chosen is None:
        return study
    wanted = [name.strip() for name in chosen.split(",")]
    there = {name for one in study.configurations for name in algorithms(one)}
    for name in wanted:
        if name not in there:
            raise unknown("algorithms", name, there)
    kept = [
        dict(one) | {"algorithm": [name for name in algorithms(one) if name in wanted]}
        for one in study.configurations
    ]
    return study._replace(configurations=[one for one in kept if one["algorithm"]])


def check_settings(name: str, said: Any) -> None:
    """Raise a ConfigError where settings, or an algorithm's own among them, are no table of names."""
    if not isinstance(said, dict) or not all(isinstance(key, str) for key in said):
        raise ConfigError(f"{name}={said}; give keys and values")
    for algorithm in ALGORITHMS:
        if algorithm in said:
            check_settings(algorithm, said[algorithm])


def algorithms(configuration: Mapping[str, Any]) -> list[str]:
    """Those of an entry of `configurations`; raises a ConfigError where it names none."""
    named = configuration["algorithm"]
    found = named if isinstance(named, list) else [named]
    if not found or not all(isinstance(one, str) for one in found):
        raise ConfigError(f"algorithm={named}; give a name, or a list of some")
    return found


def configurations(study: Study, out: Path) -> list[Configuration]:
    """The configurations of a study below a folder.

    Raises a ConfigError where a setting is wrong, or two configurations share a folder.
    """
    found: list[Configuration] = []
    left = MOST_CONFIGURATIONS
    try:
        for configuration in study.configurations:
            for algorithm in algorithms(configuration):
                if algorithm not in ALGORITHMS:
                    raise unknown("algorithm", algorithm, ALGORITHMS)
                own = _of(algorithm, study.settings) | _of(algorithm, configuration)
                several = {**own, "algorithm": algorithm, **study.given}
                left -= _number(several)
                if left < 0:
                    raise ConfigError(
                        f"configurations stand for more than {MOST_CONFIGURATIONS:,} runs; give fewer values"
                    )
                found += [
                    _configuration(one, out)._replace(study=study.name) for one in _combinations(several)
                ]
        for folder, number in Counter(one.out for one in found).items():
            if number > 1:
                raise ConfigError(
                    f"folder={folder}: two configurations share it; name in braces what they differ in"
                )
    except (ConfigError, LayoutError) as error:
        raise ConfigError(f"study {study.name}: {error}") from error
    return found


def _of(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that apply to an algorithm: those of all, and those below its own name."""
    own: dict[str, Any] = settings.get(algorithm, {})
    return {key: value for key, value in settings.items() if key not in ALGORITHMS} | own


def _is_list(key: str, value: Any) -> bool:
    """Whether a value stands for several configurations; a list of units or of shares is one value."""
    return isinstance(value, list) and (key not in LISTS or any(isinstance(one, list) for one in value))


def _number(several: Mapping[str, Any]) -> int:
    """How many combinations `_combinations` gives."""
    return math.prod(len(value) for key, value in several.items() if _is_list(key, value))


def _combinations(several: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    values = {key: value if _is_list(key, value) else [value] for key, value in several.items()}
    for key, value in values.items():
        if not value:
            raise ConfigError(f"{key}=[]; give at least one value")
    for chosen in itertools.product(*values.values()):
        yield dict(zip(values, chosen, strict=True))


def _configuration(said: Mapping[str, Any], out: Path) -> Configuration:
    settings = {key: value for key, value in said.items() if key not in OF_CONFIGURATIONS}
    if "layouts" in settings:
        settings["layouts"] = _filled("layouts", settings["layouts"], {"out": out})
    config: TrainConfig = ALGORITHMS[said["algorithm"]].config.from_mapping(settings)
    names = {key: "null" if value is None else value for key, value in said.items()}
    folder = _filled("folder", said.get("folder", ""), names)
    if not _is_folder(folder):
        raise ConfigError(
            f"folder={folder}: no folder has such a name; give a shorter one of printable characters"
        )
    if not (out / folder).resolve().is_relative_to(out.resolve()):
        raise ConfigError(f"folder={folder}: leads out of the study's own; give one within")
    own = "test" if judged_on(config.layouts) == config.layouts else judged_on(config.layouts)
    usual = Protocol(own, EPISODES, TASKS[config.task].limit(MAX_STEPS))
    evaluations, across, measures = _evaluations(said.get("evaluate", True), usual)
    for one in evaluations:
        n_layouts = SPLITS["test"].n if one.layouts == own else len(layouts.load(one.layouts, config.world))
        if one.episodes > n_layouts:
            raise ConfigError(
                f"evaluate.episodes={one.episodes}; give at most {n_layouts}, the split's layouts"
            )
        if one.at is not None and one.at not in config.keep_at:
            raise ConfigError(
                f"evaluate.at={told(one.at)}; give some of keep_at={shown(config.keep_at)}, or null"
            )
    return Configuration(
        config, out / folder / config.algorithm / config.activation, evaluations, across, measures
    )


def _filled(key: str, pattern: Any, names: Mapping[str, Any]) -> str:
    """A pattern with its names in braces filled in; a long format would ask for gigabytes."""
    filled = ""
    try:
        for text, name, width, conversion in string.Formatter().parse(str(pattern)):
            if conversion or not re.fullmatch(FORMAT, width or "") or (name and re.search(r"[^\w.]", name)):
                raise ValueError("it has more than names in braces, and short formats such as {lr:.3g}")
            if name is not None and name not in names:
                raise KeyError(name)
            filled += text + ("" if name is None else format(names[name], width or ""))
            if len(filled) > PATH:
                raise ValueError(f"it has more than {PATH:,} characters")
    except KeyError as error:
        raise ConfigError(f"{key}={pattern}: names {error}, which the configuration does not set") from error
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{key}={pattern}: cannot be filled in ({error}); give names such as {{lr}}"
        ) from error
    return filled


def _is_folder(name: str) -> bool:
    if not name.isprintable() or len(name) > PATH:
        return False
    return all(len(part.encode()) <= 255 for part in name.split("/"))


def _evaluations(said: Any, usual: Protocol) -> tuple[tuple[Protocol, ...], tuple[str, ...], bool]:
    """How a configuration is evaluated, across which ladders, and whether with more measures; usual: what
    holds where nothing is said.
    """
    if isinstance(said, bool):
        return (usual,) * said, (), False
    known = (*PROTOCOL, "across", "measures")
    if not isinstance(said, dict) or not said.keys() <= {*known}:
        raise ConfigError(f"evaluate={said}; give true, false, or some of {', '.join(known)}")
    across, measures = said.get("across", []), checked("evaluate.measures", said.get("measures", False), bool)
    if not isinstance(across, list) or not all(name in LADDER_NAMES for name in across):
        raise ConfigError(f"across={across}; give a list of some of {', '.join(LADDER_NAMES)}")
    several = {"episodes": usual.episodes, "max_steps": usual.max_steps} | said
    own = {key: value for key, value in several.items() if key in PROTOCOL}
    if (evaluations := _number(own)) > MOST_EVALUATIONS:
        raise ConfigError(f"evaluate: {evaluations:,} of each run; give at most {MOST_EVALUATIONS}")
    return (
        tuple(_evaluation(one, usual) for one in _combinations(own)),
        tuple(dict.fromkeys(across)),
        measures,
    )


def _evaluation(said: Mapping[str, Any], usual: Protocol) -> Protocol:
    checked("evaluate.shield", said.get("shield", False), bool)
    own = {key: value for key, value in said.items() if value is not None and value is not False}
    for key in ("episodes", "max_steps"):
        own[key] = checked(f"evaluate.{key}", said[key], Annotated[Whole, Field(ge=1, le=MOST_STEPS)])
    for key in ("layouts", "faults"):
        if not isinstance(own.get(key, ""), str):
            raise ConfigError(f"evaluate.{key}={own[key]}; give a name")
    if "faults" in own:
        try:
            own["faults"] = from_words(own["faults"])
        except ValueError as error:
            raise ConfigError(f"evaluate.faults={own['faults']}: {error}") from error
    return usual._replace(**own)
