"""Tuning: the same number of trials for each algorithm of a study, over the search space of its file.

Optuna asks and is told, and keeps its journal as lines of JSON in `journal.jsonl`. Trials are configurations
like any other, asked for in rounds of `at_once`, each with a sampler whose seed is its number: whatever
kills the study, the same command ends with the same trials. `trials.csv` and `importance.csv` are read
without Optuna.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import files
from uavnav.errors import ConfigError
from uavnav.runs.tables import RunError, joined, lock, read_table, write
from uavnav.runs.trials import COLUMNS, DIVERGED, FINISHED, IMPORTANCE, OF_IMPORTANCE, TABLE, read
from uavnav.studies import Configuration
from uavnav.studies.run import Work
from uavnav.studies.search import Plan

JOURNAL = "journal.jsonl"
JOURNAL_BYTES = 2**26  # of the journal, at most: a trial has some hundreds
PLAN = "plan"  # an attribute of Optuna's studies: what their trials have in common


Train = Callable[[Sequence[Configuration]], list[Work]]


def tune(found: Plan, train: Train, say: Callable[[str], None] = print) -> list[Work]:
    """Ask, train and tell, until each algorithm has its trials; train: returns those that failed.

    Returns:
        The trials that failed for another reason than that they diverged; the same call repeats them.

    Raises:
        ConfigError: Optuna is not installed, or the folder contains the trials of another plan.
        RunError: another process tunes there.
    """
    optuna = _optuna()
    found.folder.mkdir(parents=True, exist_ok=True)
    with lock(found.folder):
        storage = _storage(optuna, found.folder / JOURNAL)
        searches = {name: _search(optuna, storage, found, name) for name in found.algorithms}
        while True:
            round_ = [
                (search, trial, found.trial(name, trial.number, trial.params))
                for name, search in searches.items()
                for trial in _ask(optuna, found, name, search)
            ]
            if not round_:
                break
            failed = {str(work.configuration.out): work for work in train([one for _, _, one in round_])}
            if others := [work for work in failed.values() if not work.diverged]:
                return others
            for search, trial, configuration in round_:
                value = math.nan if str(configuration.out) in failed else objective(configuration)
                if math.isfinite(value):
                    search.tell(trial.number, value)
                else:
                    search.tell(trial.number, state=optuna.trial.TrialState.FAIL)
            _keep(found, searches)
            counts = ", ".join(f"{name} {len(_told(search))}" for name, search in searches.items())
            say(f"{found.folder}: trials of {found.trials}: {counts}")
        _keep(found, searches)
        _put(found.folder / IMPORTANCE, _importance(optuna, searches), list(searches))
    return []


def objective(configuration: Configuration) -> float:
    """The mean reward of a trial's sampled episodes, all seeds alike."""
    rows = read_table(
        configuration.out / configuration.episodes[0],
        {"mode": "object", "reward": "float64"},
        "evaluate it again",
    )
    return float(rows.loc[rows["mode"] == "sampled", "reward"].mean())


def _optuna() -> Any:
    try:
        import optuna
        import sklearn  # noqa: F401 - which Optuna's importance asks for when the study has ended
    except ImportError as error:
        raise ConfigError("a study that tunes needs Optuna; pip install 'uavnav[tune]' brings it") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _storage(optuna: Any, journal: Path) -> Any:
    """The journal; half a line at its end, of a write that was cut off, is taken from it."""
    try:
        if os.path.lexists(journal):
            said = files.read(journal, JOURNAL_BYTES)
            for line in said.split(b"\n")[:-1]:
                files.parsed(line)  # Optuna takes damage for a line that is still being written
            os.truncate(journal, said.rfind(b"\n") + 1)  # else the next line would be joined to it
        return optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(journal)))
    except Exception as error:  # Optuna raises any kind at a line that it has not written
        raise RunError(
            f"{journal}: cannot be read ({' '.join(str(error).split())}); give another out="
        ) from error


def _search(optuna: Any, storage: Any, found: Plan, algorithm: str) -> Any:
    """The study of Optuna's with an algorithm's trials, new or as it was left."""
    search = optuna.create_study(
        storage=storage, study_name=algorithm, direction="maximize", load_if_exists=True
    )
    space = {setting: found.range(algorithm, setting) for setting in found.said["space"][algorithm]}
    given = found.study.given
    same = {"space": space, "seeds": given.get("n_seeds"), "frames": given.get("total_frames")}
    same = json.loads(json.dumps(same | {key: found.said[key] for key in ("settings", "at_once")}))
    if PLAN not in search.user_attrs:
        search.set_user_attr(PLAN, same)
    if search.user_attrs[PLAN] != same:
        raise ConfigError(
            f"{found.folder / JOURNAL}: contains the trials of another search; give another out="
        )
    return search


def _ask(optuna: Any, found: Plan, algorithm: str, search: Any) -> list[Any]:
    """The trials of a round: those that were asked for and never told, and new ones to fill it.

    A new one is thought out in memory and written as one line, so that no kill leaves a half of it.
    """
    ranges = {
        name: _distribution(optuna, found.range(algorithm, name)) for name in found.said["space"][algorithm]
    }
    while True:
        there = search.get_trials(deepcopy=False)
        running = [trial for trial in there if not trial.state.is_finished()]
        if len(there) >= found.trials or (running and len(there) % found.said["at_once"] == 0):
            return running
        aside = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=len(there)))
        aside.add_trials(there)
        if not there:
            aside.enqueue_trial(found.defaults(algorithm))
        new = aside.ask(ranges).params
        state = optuna.trial.TrialState.RUNNING
        search.add_trial(optuna.trial.create_trial(state=state, params=new, distributions=ranges))


def _distribution(optuna: Any, values: Any) -> Any:
    if isinstance(values, list):
        return optuna.distributions.CategoricalDistribution(values)
    whole = all(type(values[end]) is int for end in ("low", "high"))
    kind = optuna.distributions.IntDistribution if whole else optuna.distributions.FloatDistribution
    return kind(**values)


def _told(search: Any) -> list[Any]:
    return [trial for trial in search.get_trials(deepcopy=False) if trial.state.is_finished()]


def _keep(found: Plan, searches: Mapping[str, Any]) -> None:
    rows = [
        [
            name,
            trial.number,
            DIVERGED if trial.value is None else FINISHED,
            trial.value,
            json.dumps(trial.params),
        ]
        for name, search in searches.items()
        for trial in _told(search)
    ]
    _put(found.folder / TABLE, pd.DataFrame(rows, columns=[*COLUMNS]), list(searches))


def _put(path: Path, table: pd.DataFrame, algorithms: Sequence[str]) -> None:
    """Write what there is of some algorithms; rows of others, which a call before this one searched, stay."""
    there = read(path, COLUMNS if path.name == TABLE else OF_IMPORTANCE)
    others = there[~there["algorithm"].isin(algorithms)]
    write(path, joined([others, table]).to_csv(index=False).encode())


def _importance(optuna: Any, searches: Mapping[str, Any]) -> pd.DataFrame:
    """How much of the variation of values each setting explains, by fANOVA (Hutter et al. 2014)."""
    rows = []
    for name, search in searches.items():
        evaluator = optuna.importance.FanovaImportanceEvaluator(seed=0)
        # fewer than two trials, or all have the same value
        with contextlib.suppress(ValueError, RuntimeError):
            found = optuna.importance.get_param_importances(search, evaluator=evaluator)
            rows += [[name, setting, float(share)] for setting, share in found.items()]
    return pd.DataFrame(rows, columns=[*OF_IMPORTANCE])
