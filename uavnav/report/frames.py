"""The numbers of the report as data frames, one row a number or a seed: what `tables/*.csv` contains.

Every function takes the configurations of a study and gives a frame; the page, the figures and the Markdown
show parts of them. To add a metric, add a line to `metrics.METRICS`; to add a measure of episodes, a column
to `behaviour.measures`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report import claims
from uavnav.report.claims import AFTER, BOUNDED, PAIR, PRIMARY, UNBOUNDED, WHEN, Evidence
from uavnav.report.configurations import Configuration, Key, algorithms, episodes_of, order, read_as, windowed
from uavnav.report.studies import Configurations, Studies, hours, paper_configurations, timed
from uavnav.report.verdicts import COUNTS, Finding, grade, of_claim
from uavnav.runs import paper
from uavnav.runs.definitions import DEFINITIONS, EVALUATIONS, LOG_CURVE, PER_FRAME, SAMPLED
from uavnav.runs.evaluations import Protocol
from uavnav.runs.metrics import EVALUATED, finished, has_ended
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks.protocol import MAX_STEPS

DIAGNOSTICS = {
    "dormant": "dormant hidden units [share]",
    "saturated": "saturated activations [share]",
    "effective_rank": "effective rank of the last hidden layer [dimensions]",
    "grad_norm": "gradient norm before clipping",
    "entropy": "entropy of the policy [nat]",
    "q_value": "mean of max Q in training [reward]",
}
"""What a run's progress tells of its networks: columns that may say why activations differ."""
MEASURES = {
    "clearance": "clearance [px]",
    "corridor": "steps in corridors [share]",
    "corridor_path": "path in corridors [share]",
    "reversals": "reversals of turn [share of steps]",
    "straight_speed": "speed going straight [px a step]",
    "turning_speed": "speed in turns [px a step]",
}
"""How a policy flies: the columns of `behaviour.measures`."""
OVERESTIMATION = {
    "q": "max Q [reward]",
    "realised": "realised [reward]",
    "overestimation": "overestimation [reward]",
}
"""What a seed expects and gets: columns of `evaluation.values.overestimation`."""
REACTIVE = "reactive"
"""The scripted policy that everything learned is compared with: `uavnav.tasks.baselines.reactive`."""
VECTORISED = "many environments"
"""The setting in which the study in many environments differs from that in one."""
SB3 = "SB3's log"
CONCLUSIONS = {
    "tanh − relu": (("tanh",), ("relu",)),
    "bounded − unbounded": (BOUNDED, UNBOUNDED),
    "tanh − sigmoid": (("tanh",), ("sigmoid",)),
    "relu − leaky_relu": (("relu",), ("leaky_relu",)),
}
"""What is said of activations, as differences of the mean reward per frame of some and of others."""
NUMBERS = ["value", "low", "high", "n"]
AS_DECIDED = "default"
"""The switch that changes nothing."""

Arguments = ParamSpec("Arguments")
Rows = Iterator[Sequence[Any]]


def columns(*names: str) -> Callable[[Callable[Arguments, Rows]], Callable[Arguments, pd.DataFrame]]:
    """Let a function that yields rows return a frame of them with these columns."""

    def of(rows: Callable[Arguments, Rows]) -> Callable[Arguments, pd.DataFrame]:
        @functools.wraps(rows)
        def table(*args: Arguments.args, **kwargs: Arguments.kwargs) -> pd.DataFrame:
            return pd.DataFrame([*rows(*args, **kwargs)], columns=[*names])

        return table

    return of


def name(algorithm: str, activation: str) -> str:
    return f"{algorithm.upper()} {activation}"


def of_seeds(configuration: Configuration, definition: str) -> stats.Array:
    """The reward of a configuration in one metric definition: a number a seed [S]."""
    return read_as(configuration, definition)["reward"].dropna().to_numpy()


def rewards(configurations: Configurations, definition: str) -> dict[str, stats.Array]:
    """`of_seeds` of each configuration, by its name."""
    return {name(*key): of_seeds(one, definition) for key, one in configurations.items()}


def per_seed_values(configurations: Configurations) -> pd.DataFrame:
    """Columns algorithm, activation, definition, metric, seed, value."""
    names = ["algorithm", "activation", "definition", "metric", "seed", "value"]
    parts = {
        (*key, definition): table.melt(var_name="metric", ignore_index=False)
        for (key, one), definition in itertools.product(configurations.items(), DEFINITIONS)
        if len(table := read_as(one, definition))
    }
    if not parts:
        return pd.DataFrame(columns=names)
    return pd.concat(parts, names=[*names[:3], "seed"]).reset_index()[names]


@columns(
    *("algorithm", "activation", "definition", "metric", "n", "mean", "low", "high"),
    *("interquartile_mean", "iqm_low", "iqm_high", "paper"),
)
def estimates(values: pd.DataFrame) -> Rows:
    """Mean and interquartile mean over seeds, with 95 % intervals, and the paper's number."""
    for key, part in values.groupby(["algorithm", "activation", "definition"], sort=False):
        algorithm, activation, definition = map(str, key)
        for metric, (mean, middle) in means(part.groupby("metric", sort=False)["value"]).items():
            printed = paper.printed(algorithm, activation, metric, definition == PER_FRAME)
            yield [*key, metric, mean.n, *mean[:3], *middle[:3], printed]


def means(seeds: Iterable[tuple[Any, pd.Series[float]]]) -> dict[str, list[stats.Interval]]:
    """Mean and interquartile mean over seeds, with 95 % intervals, by metric; seeds: [S] of each."""
    rows = {str(metric): values.to_numpy(np.float64).tobytes() for metric, values in seeds}
    return dict(zip(rows, _intervals(tuple(rows.values())), strict=True))


@functools.lru_cache(maxsize=8192)
def _intervals(rows: tuple[bytes, ...]) -> list[list[stats.Interval]]:
    """What `means` gives, of rows of float64 [S] as bytes: `estimates` asks first, the pages after it."""
    return stats.intervals([np.frombuffer(row) for row in rows], [np.mean, stats.interquartile_mean])


@columns(*Finding._fields, "column")
def verdicts(audits: Mapping[str, Sequence[Finding]]) -> Rows:
    """Every part of every claim in every column of `claims.COLUMNS`."""
    for column, findings in audits.items():
        yield from ((*finding, column) for finding in findings)


@columns("claim", "column", "grade", "replicating", "counting", "least", "most")
def grades(audits: Mapping[str, Sequence[Finding]]) -> Rows:
    """The grade of each claim in each column, its parts that replicate and that count, and their seeds."""
    numbers = sorted({one.claim for findings in audits.values() for one in findings})
    for number, (column, findings) in itertools.product(numbers, audits.items()):
        mine = of_claim(findings, number)
        judged = [one for one in mine if one.standing == COUNTS and one.n] or mine
        if seeds := [one.n for one in judged if one.n]:
            yield [number, column, *grade(mine), min(seeds), max(seeds)]


@columns("algorithm", "activation", "metric", "definition", "paper", *stats.Prediction._fields)
def predictions(evidence: Mapping[str, Evidence]) -> Rows:
    """Each of the paper's numbers among our seeds (`stats.prediction`); evidence: by metric definition."""
    for definition, key, metric in itertools.product(evidence, paper.TABLES, paper.COLUMNS):
        number = paper.printed(*key, metric, definition == PER_FRAME)
        found = stats.prediction(evidence[definition](*key, metric), number)
        yield [*key, metric, definition, number, *found]


def improvement(configurations: Configurations) -> pd.DataFrame:
    """How probably a seed of one configuration beats a seed of another (`stats.improvement`)."""
    return stats.improvement(rewards(configurations, PRIMARY))


@columns("definition", "metric", *stats.Interaction._fields)
def interactions(values: pd.DataFrame) -> Rows:
    """Whether activations change places between the paper's algorithms (`stats.interaction`)."""
    of_paper = [key in paper.TABLES for key in zip(values["algorithm"], values["activation"], strict=True)]
    known = values[np.array(of_paper, bool)].dropna()  # an empty list would name no columns
    for definition, metric in itertools.product((PRIMARY, SAMPLED), ("reward", "steps", "distance")):
        own = known[(known["definition"] == definition) & (known["metric"] == metric)]
        yield [definition, metric, *stats.interaction(own[["algorithm", "activation", "value"]])]


def survival(
    configurations: Configurations, baselines: Mapping[str, pd.DataFrame]
) -> tuple[dict[str, pd.Series], pd.DataFrame]:
    """Kaplan-Meier curves of sampled episodes, all seeds together, and restricted means over seeds."""
    curves, rows = {}, []
    learned = {name(*key): episodes_of(one, SAMPLED) for key, one in configurations.items()}
    for label, part in {**learned, **baselines}.items():
        if part.empty:
            continue
        curves[label] = stats.survival(part["steps"].to_numpy(), part["terminated"].to_numpy())
        mean = stats.interval(
            [
                stats.restricted_mean(one["steps"].to_numpy(), one["terminated"].to_numpy(), MAX_STEPS)
                for _, one in part.groupby("seed")
            ]
        )
        rows.append([label, mean.n, len(part), part["truncated"].mean(), *mean[:3]])
    columns = ["configuration", "n", "episodes", "truncated", "restricted_mean", "low", "high"]
    return curves, pd.DataFrame(rows, columns=columns)


@columns("pair", "n", "seeds")
def power(configurations: Configurations) -> Rows:
    """Seeds that find the paper's difference in reward of two activations: 80 % power at 5 %."""
    known = {key: of_seeds(one, PRIMARY) for key, one in paper_configurations(configurations).items()}
    for a, b in itertools.combinations(sorted(known, key=order), 2):
        if a[0] == b[0]:
            first, second = (paper.printed(*key, "reward", PRIMARY == PER_FRAME) for key in (a, b))
            needed = stats.seeds_needed(known[a], known[b], first - second)
            yield [f"{a[0].upper()}: {a[1]} and {b[1]}", min(len(known[a]), len(known[b])), needed]


def watched(episodes: Mapping[tuple[str, str, str], pd.DataFrame]) -> pd.DataFrame:
    """What episodes of the main study look like, one row a configuration, mode and seed."""
    parts = [
        table.assign(configuration=name(*key), algorithm=key[0], activation=key[1])
        for (study, *key), table in episodes.items()
        if study == "main"
    ]
    columns = ["mode", "seed", "configuration", "algorithm", "activation"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def last_tenth(progress: pd.DataFrame, frames: int) -> pd.DataFrame:
    """Means over the last tenth of training: a row a seed, a column of progress."""
    return progress[progress["frame"] > 0.9 * frames].groupby("seed").mean()


@columns("configuration", "diagnostic", "n", "value", "low", "high")
def diagnostics(configurations: Configurations) -> Rows:
    """The last tenth of training: mean over seeds and its interval of each diagnostic."""
    for key, configuration in configurations.items():
        progress = pd.concat([run.progress for run in configuration.runs], ignore_index=True)
        seeds = last_tenth(progress, configuration.settings["frames"])
        for column in (one for one in DIAGNOSTICS if one in seeds):
            *mean, n = stats.interval(seeds[column].to_numpy())
            yield [name(*key), column, n, *mean]


# -- differences of configurations ---------------------------------------------------------------------------


def _halves(samples: Sequence[stats.Array]) -> stats.Interval:
    """The mean of the first half of some configurations minus that of the second."""
    half = len(samples) // 2
    return stats.difference(samples[:half], samples[half:])


@columns("switch", "conclusion", *NUMBERS, "flips")
def sensitivity(studies: Studies) -> Rows:
    """Each conclusion under each switch and as decided.

    An algorithm that a switch does not touch is taken as decided. `flips`: the interval is wholly on the
    other side of zero than as decided; `sign` if only the estimate does.
    """
    decided: dict[str, stats.Interval] = {}
    conclusions: dict[str, tuple[str, ...]] = {
        " above ".join(map(str.upper, claims.COMPARED)): claims.COMPARED
    }
    for one in (*claims.COMPARED, *algorithms(studies.baseline)):
        conclusions[f"{one.upper()}: tanh above ReLU"] = (one,)
    for switch, own in {AS_DECIDED: studies.baseline, **studies.switches}.items():
        there = studies.baseline | own
        for conclusion, which in conclusions.items():
            keys = [*itertools.product(which, PAIR)]
            if there.keys() >= {*keys} and not own.keys().isdisjoint(keys):
                found = _halves([of_seeds(there[key], PRIMARY) for key in keys])
                yield [switch, conclusion, *found, _flips(decided.get(conclusion), found)]
                if switch == AS_DECIDED:
                    decided[conclusion] = found


def _flips(decided: stats.Interval | None, found: stats.Interval) -> str:
    """Whether a switch changes a conclusion, as `sensitivity` says; empty where it cannot."""
    if decided is None:
        return ""
    if not decided.value * found.value < 0:
        return "no"
    return "yes" if decided.low * decided.high > 0 and found.low * found.high > 0 else "sign"


@columns("switch", "algorithm", "frames", *NUMBERS)
def effects(studies: Studies) -> Rows:
    """What a setting changes in an algorithm's reward per frame.

    The mean over the activations that both have, minus that as decided; many environments minus one. frames:
    a seed.
    """
    pairs = [(switch, changed, studies.baseline) for switch, changed in studies.switches.items()]
    pairs.append((VECTORISED, paper_configurations(studies.vectorised), paper_configurations(studies.main)))
    for switch, changed, usual in pairs:
        for algorithm, keys in _shared(changed, usual):
            samples = [of_seeds(one[key], PRIMARY) for one in (changed, usual) for key in keys]
            frames = max(changed[key].settings["frames"] for key in keys)
            yield [switch, algorithm, frames, *_halves(samples)]


def _shared(first: Configurations, second: Configurations) -> Iterable[tuple[str, list[Key]]]:
    """The configurations that both have, by algorithm."""
    shared = [key for key in first if key in second]
    for algorithm in dict.fromkeys(which for which, _ in shared):
        yield algorithm, [key for key in shared if key[0] == algorithm]


@columns("measure", "algorithm", *NUMBERS)
def one_against_many(studies: Studies) -> Rows:
    """One environment per seed against many, in more than the mean.

    One minus many, mean over the activations that both studies have, with Welch's interval over seeds:

    - scatter: the standard deviation over seeds of reward per frame in the last 100,000 frames
      (`stats.deviations`);
    - longest: the longest episode of a seed that is open at the end [steps], 0 where none is;
    - open: the share of a seed's frames in episodes that are open at the end.

    order: Kendall's tau, one against many, of the activations' mean rewards per frame (`stats.concordance`).
    """

    def measured(configuration: Configuration) -> dict[str, stats.Array]:
        frames, episodes = configuration.settings["frames"], configuration.episodes
        late = windowed(configuration, [(frames - AFTER, frames)])[0]
        steps = episodes["steps"].mask(has_ended(episodes), 0)
        longest, together = (getattr(steps.groupby(episodes["seed"]), one)() for one in ("max", "sum"))
        of_open = {"longest": longest.to_numpy(np.float64), "open": (together / frames).to_numpy()}
        return {"scatter": stats.deviations(late.to_numpy()), **of_open}

    one, many = paper_configurations(studies.main), paper_configurations(studies.vectorised)
    for algorithm, keys in _shared(one, many):
        both = [measured(found[key]) for found in (one, many) for key in keys]
        yield from ([measure, algorithm, *_halves([own[measure] for own in both])] for measure in both[0])
        first, second = ([of_seeds(found[key], PRIMARY) for key in keys] for found in (one, many))
        yield ["order", algorithm, *stats.concordance(first, second)]


@columns("settings", "activations", *NUMBERS)
def by_default(studies: Studies, winners: Configurations) -> Rows:
    """PPO's reward minus DQN's with other settings and in the main study.

    The first two rows are of the activations that both algorithms have with the preset `fast`. winners: of
    trials; a row each for them, and for the lead with the preset minus theirs.
    """
    first, second = claims.COMPARED
    shared = [one for which, one in studies.tuned if which == first and (second, one) in studies.tuned]
    words = ", ".join(shared)

    def earned(found: Configurations, activations: Sequence[str]) -> list[stats.Array]:
        keys = itertools.product(claims.COMPARED, activations)
        return [of_seeds(found[key], SAMPLED) if key in found else np.empty(0) for key in keys]

    fast, searched = earned(studies.tuned, shared), earned(winners, ["tanh"])
    yield [f"preset {claims.FAST}", words, *_halves(fast)]
    yield ["main study", words, *_halves(earned(studies.main, shared))]
    if shared and min(map(len, [*fast, *searched])) > 1:
        yield [claims.TUNED, "tanh", *_halves(searched)]
        share = 1 / len(shared)
        weights = np.array([share, -share, -1, 1]).repeat([len(shared), len(shared), 1, 1])
        lead = stats.contrast([*fast, *searched], weights)
        yield [f"preset {claims.FAST} − {claims.TUNED}", words, *lead]


def carried(studies: Studies, evidence: Evidence) -> pd.DataFrame:
    """What is said of activations, by algorithm, in many environments: conclusion, algorithm, `NUMBERS`.

    None unless an algorithm beyond the paper's has runs with the activations that some conclusion asks for.
    """
    rows = []
    there = algorithms(studies.of("vectorised"))
    for (label, sides), algorithm in itertools.product(CONCLUSIONS.items(), there):
        first, second = (
            [evidence(algorithm, one, "reward", study="vectorised") for one in side] for side in sides
        )
        if all(map(len, [*first, *second])):
            rows.append([label, algorithm, *stats.difference(first, second)])
    found = pd.DataFrame(rows, columns=["conclusion", "algorithm", *NUMBERS])
    return found if {*found["algorithm"]} - {*paper.TABLE_OF} else found[:0]


# -- the paper's numbers, and what scripted policies reach ---------------------------------------------------


@columns("algorithm", "definition", "what", "share", "n")
def one_run(values: pd.DataFrame) -> Rows:
    """What one run a configuration, as the paper has, would say of reward: how often an activation would be
    the best of its algorithm, and how often all would stand in the paper's order.

    values: as `per_seed_values` gives them.
    """
    chosen = values[(values["metric"] == "reward") & values["activation"].isin(paper.ACTIVATIONS)]
    chosen = chosen[chosen["definition"].isin(claims.COLUMNS.values())]
    for (algorithm, definition), part in chosen.groupby(["algorithm", "definition"], sort=False):
        seeds = {str(key): own.dropna().to_numpy() for key, own in part.groupby("activation")["value"]}
        per_frame = definition == PER_FRAME
        printed = {one: paper.printed(str(algorithm), one, "reward", per_frame) for one in seeds}
        n = min(map(len, seeds.values()))
        if len(seeds) < len(paper.ACTIVATIONS) or not n or not all(np.isfinite([*printed.values()])):
            continue
        in_order = sorted(seeds, key=lambda one: -printed[one])
        shares = {f"{one} is best": stats.chance_of_best(seeds, one) for one in in_order}
        shares["the paper's order"] = stats.chance_of_order([seeds[one] for one in in_order])
        yield from ([algorithm, definition, what, share, n] for what, share in shares.items())


def lost(before: stats.Array, surge: stats.Array, after: stats.Array) -> stats.Interval:
    """The share of the rise in reward [S] from before to the surge that is gone after it."""
    return stats.ratio(surge - after, surge - before)


@columns("configuration", "measure", *NUMBERS)
def peaks(configurations: Configurations, evidence: Mapping[str, Evidence]) -> Rows:
    """When a configuration earns most per frame, and what it loses after 600,000 frames.

    `peak` is the middle of each seed's best stretch of training [frames]; `lost` the share of the rise in
    reward per frame, from the first 300,000 frames to the next, that is gone in the last 100,000 (Fieller's
    interval). The same by SB3's log (reward per episode), its means in these stretches, and how many seeds
    lose more than half. Shorter trainings have no rows. evidence: by metric definition.
    """
    for key, configuration in configurations.items():
        earned, logged = (
            [evidence[one](*key, f"reward_{when}") for when in WHEN] for one in (PRIMARY, LOG_CURVE)
        )
        if not len(earned[0]):
            continue
        best = configuration.curve.round(9).idxmax()  # of equal ones the first
        found = {"peak": stats.difference([np.asarray(best, dtype=np.float64)]), "lost": lost(*earned)}
        found |= {f"{when}, {SB3}": stats.difference([one]) for when, one in zip(WHEN, logged, strict=True)}
        found[f"lost, {SB3}"] = lost(*logged)
        before, surge, after = logged
        halved = int((surge - after > (surge - before) / 2).sum())
        found[f"seeds that lose half, {SB3}"] = stats.Interval(halved, np.nan, np.nan, len(after))
        yield from ([name(*key), measure, *one] for measure, one in found.items())


@columns("definition", "configuration", "within", "numbers", "score", "p", "farther")
def fits(predictions: pd.DataFrame, evidence: Mapping[str, Evidence]) -> Rows:
    """How well the paper's numbers fit our prediction intervals.

    Of so many numbers, so many are within. A wide interval contains any number, so the score of a 95 %
    interval (Gneiting and Raftery 2007, eq. 43) is its width plus 2 / 0.05 times how far it misses the
    number; the mean over numbers, each score in units of the paper's number. Less is better.

    p, farther: of a configuration's six numbers as one seed (`stats.joint`): its p value, and the share of
    our seeds that the paper's run is farther out than. predictions: as `frames.predictions` gives it;
    numbers without seeds are left out; evidence: by metric definition.
    """
    known = predictions[predictions["n"] > 1]
    low, high, number = (known[column] for column in ("low", "high", "paper"))
    missed = (low - number).clip(lower=0) + (number - high).clip(lower=0)
    known = known.assign(score=(high - low + 2 / 0.05 * missed) / number.abs())
    for definition, own in known.groupby("definition", sort=False):
        groups: list[tuple[Any, pd.DataFrame]] = [((), own)]
        for key, part in [*groups, *own.groupby(["algorithm", "activation"], sort=False)]:
            of = evidence[str(definition)]
            seeds = [of(str(key[0]), str(key[1]), metric) for metric in part["metric"] if key]
            as_one = len({*map(len, seeds)}) == 1
            joint = stats.joint(np.stack(seeds, 1), part["paper"].to_numpy()) if as_one else [np.nan] * 2
            facts = int(part["within"].sum()), len(part), part["score"].mean()
            yield [definition, name(*key) if key else "all configurations", *facts, *joint]


@columns(
    *("who", "algorithm", "mode", "limit", "n", "episodes", "truncated", "reward", "low", "high"),
    *("per_frame", "gap", "gap_low", "gap_high", "above"),
)
def gaps(configurations: Configurations, scripted: Mapping[str, pd.DataFrame]) -> Rows:
    """Reward of test episodes, and its gap to that of `reactive` on the same layouts.

    `truncated` is the share of episodes that the time limit [steps] ended, `above` the share of seeds above
    `reactive`. A gap is a mean over seeds of each seed's mean over layouts, with Student's 95 % interval over
    seeds; it is NaN without episodes of `reactive` on the same layouts and below the same time limit.
    `per_frame` is reward over steps, mean over seeds.
    """
    known = [(who, "", "scripted", table) for who, table in scripted.items()]
    known += [
        (name(*key), key[0], definition.split()[0], episodes_of(one, definition))
        for definition, (key, one) in itertools.product(EVALUATIONS, configurations.items())
    ]
    of_reactive = finished(scripted[REACTIVE]) if REACTIVE in scripted else pd.DataFrame()
    for who, algorithm, mode, table in known:
        ended = finished(table)
        if ended.empty:
            continue
        by_seed = ended.groupby("seed")
        reward = stats.difference([by_seed["reward"].mean().to_numpy()])
        per_frame = (by_seed["reward"].sum() / by_seed["steps"].sum()).mean()
        own = np.empty(0) if who == REACTIVE else gap_to(ended, of_reactive)
        above = float((own > 0).mean()) if len(own) else np.nan
        facts = _limit(ended), reward.n, len(ended), ended["truncated"].mean()
        yield [who, algorithm, mode, *facts, *reward[:3], per_frame, *stats.difference([own])[:3], above]


def _limit(episodes: pd.DataFrame) -> float:
    """At how many steps episodes were truncated; NaN where none was."""
    return float(episodes.loc[episodes["truncated"], "steps"].max())


def gap_to(episodes: pd.DataFrame, scripted: pd.DataFrame) -> stats.Array:
    """Each seed's mean gap to a scripted policy on the same layouts [S]; none if their time limits differ."""
    if scripted.empty or not {*episodes["layout"]} <= {*scripted["layout"]}:
        return np.empty(0)
    if abs(_limit(episodes) - _limit(scripted)) > 0:  # a time limit that ended no episode is NaN
        return np.empty(0)
    of_scripted = episodes["layout"].map(scripted.groupby("layout")["reward"].mean())
    return (episodes["reward"] - of_scripted).groupby(episodes["seed"]).mean().to_numpy()


@columns("algorithm", "mode", "passing", "n")
def passing(gaps: pd.DataFrame) -> Rows:
    """How many seeds of an algorithm pass the scripted policy; no rows without episodes of it."""
    learned = gaps[(gaps["algorithm"] != "") & gaps["above"].notna()]
    for key, part in learned.groupby(["algorithm", "mode"], sort=False):
        yield [*key, int((part["above"] * part["n"]).round().sum()), part["n"].sum()]


def baselines(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows of scripted policies and people, `baselines/*.parquet` in the folders; what cannot be read."""
    found, left_out = {}, []
    for path in (path for folder in folders for path in sorted((folder / "baselines").glob("*.parquet"))):
        try:
            found[path.stem] = read_table(path, EVALUATED, "evaluate it again")
        except RunError as error:
            left_out.append(str(error))
    return found, left_out


def as_usual(episodes: pd.DataFrame) -> bool:
    """Whether scripted policies or people flew the paper's task on test layouts, by the file's header."""
    usual = Protocol()._asdict()
    return all(episodes.attrs.get(key, usual[key]) == usual[key] for key in usual if key != "episodes")


# -- how large and how fast ----------------------------------------------------------------------------------


@columns("configuration", "seconds", "seeds", "machine")
def speed(configurations: Configurations) -> Rows:
    """Wall time of a million frames of one seed, by run."""
    for key, configuration in configurations.items():
        for run, took in zip(timed(configuration), hours(configuration), strict=True):
            processor = run.meta.get("machine", {}).get("processor", "not known")
            yield [name(*key), 3600 * took, len(run.seeds), processor]


@columns("study", "algorithm", "activation", "seeds", "frames", "n_envs")
def sizes(studies: Studies) -> Rows:
    """How large each study is; frames and environments are a seed's."""
    named = {
        "main": paper_configurations(studies.main),
        VECTORISED: studies.vectorised,
        "baseline": studies.baseline,
        "initial": studies.initial,
        **studies.switches,
        "tuned": studies.tuned,
    }
    for study, found in named.items():
        for key, one in found.items():
            yield [study, *key, one.n_seeds, one.settings["frames"], one.settings["n_envs"]]


def spread(configurations: Configurations, setting: str) -> str:
    """A setting that counts something, such as `frames`: one number, or from ... to ..."""
    return least_to_most(one.settings[setting] for one in configurations.values())


def least_to_most(counts: Iterable[int], noun: str = "") -> str:
    """The range of some counts, one number where they are the same; noun: what is counted."""
    ordered = sorted({*counts})
    shown = " to ".join(f"{count:,}" for count in dict.fromkeys([*ordered[:1], *ordered[-1:]])) or "0"
    return f"{shown} {noun}{'s' * (ordered != [1])}" if noun else shown
