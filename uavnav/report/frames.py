"""The numbers of the report as data frames, one row a number or a seed: what `tables/*.csv` holds.

Every function takes the configurations of a study and gives a frame; the page, the figures and the Markdown
show parts of them. To add a metric, add a line to `metrics.METRICS`; to add a measure of episodes, a column
to `behaviour.measures`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report import claims
from uavnav.report.claims import BOUNDED, PAIR, PRIMARY, SURGE, UNBOUNDED, Evidence, long
from uavnav.report.configurations import (
    Configuration,
    Key,
    algorithms,
    curve,
    episodes_of,
    order,
    read_as,
    windowed,
)
from uavnav.report.studies import (
    AFTER,
    Configurations,
    Studies,
    hours,
    paper_configurations,
    timed,
)
from uavnav.report.verdicts import COUNTS, Finding, grade, of_claim
from uavnav.runs import paper
from uavnav.runs.definitions import DEFINITIONS, EVALUATIONS, PER_FRAME, SAMPLED
from uavnav.runs.metrics import EVALUATED, finished
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks.protocol import MAX_STEPS

LIMIT = MAX_STEPS
"""Steps at which the restricted mean of a survival curve ends: the evaluation's own time limit."""
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
    "corridor_flown": "distance flown in corridors [share]",
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
"""What a seed expects and gets: columns of `evaluate.values.overestimation`."""
RULE = "reactive"
"""The scripted policy that everything learned is held against: `uavnav.tasks.baselines.reactive`."""
VECTORISED = "many environments"
"""The setting in which the study in many environments differs from that in one."""
EVERY = "all configurations"
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


def name(algorithm: str, activation: str) -> str:
    """A configuration, in words."""
    return f"{algorithm.upper()} {activation}"


def of_seeds(configuration: Configuration, definition: str, metric: str = "reward") -> stats.Array:
    """A metric of a configuration in one metric definition: a number a seed [S]."""
    return read_as(configuration, definition)[metric].dropna().to_numpy()


def per_seed_values(configurations: Configurations) -> pd.DataFrame:
    """Every metric of every seed in every metric definition: algorithm, activation, definition, metric,
    seed, value.
    """
    parts = []
    for (algorithm, activation), configuration in configurations.items():
        for definition in DEFINITIONS:
            table = read_as(configuration, definition)
            seeds = np.tile(table.index.to_numpy(), table.shape[1])
            metrics = np.repeat(table.columns.to_numpy(), len(table))
            where = (np.full(table.size, one, dtype=object) for one in (algorithm, activation, definition))
            parts.append([*where, metrics, seeds, table.to_numpy().T.ravel()])
    columns = ["algorithm", "activation", "definition", "metric", "seed", "value"]
    joined = map(np.concatenate, zip(*parts, strict=True))
    return pd.DataFrame(dict(zip(columns, joined, strict=True)) if parts else None, columns=columns)


def estimates(values: pd.DataFrame) -> pd.DataFrame:
    """Mean and interquartile mean over seeds, with 95 % intervals, beside the paper's number in the same
    metric definition.
    """
    rows = []
    keys = ["algorithm", "activation", "definition"]
    numbers = ["n", "mean", "low", "high", "interquartile_mean", "iqm_low", "iqm_high", "paper"]
    for key, part in values.groupby(keys, sort=False):
        algorithm, activation, definition = map(str, key)
        of_metrics = {
            str(metric): own.to_numpy(np.float64)
            for metric, own in part.groupby("metric", sort=False)["value"]
        }
        found = _intervals(tuple(own.tobytes() for own in of_metrics.values()))
        for metric, (mean, middle) in zip(of_metrics, found, strict=True):
            printed = paper.printed(algorithm, activation, metric, definition == PER_FRAME)
            rows.append([*key, metric, mean.n, *mean[:3], *middle[:3], printed])
    return pd.DataFrame(rows, columns=[*keys, "metric", *numbers])


@functools.lru_cache(maxsize=8192)
def _intervals(rows: tuple[bytes, ...]) -> list[list[stats.Interval]]:
    """Mean and interquartile mean of rows of float64 [S] as bytes; page and report.md ask twice."""
    return stats.intervals([np.frombuffer(row) for row in rows], [np.mean, stats.interquartile_mean])


def verdicts(audits: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """Every part of every claim in every column of `claims.COLUMNS`."""
    rows = [(*finding, column) for column, findings in audits.items() for finding in findings]
    return pd.DataFrame(rows, columns=[*Finding._fields, "column"])


def grades(audits: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """The grade of each claim in each column that has runs for it: columns claim, column, grade, how many
    parts replicate of those that count, and the least and the most seeds of a part.
    """
    rows = []
    for column, findings in audits.items():
        for number in dict.fromkeys(one.claim for one in findings):
            mine = of_claim(findings, number)
            judged = [one for one in mine if one.standing == COUNTS and one.n] or mine
            if seeds := [one.n for one in judged if one.n]:
                rows.append([number, column, *grade(mine), min(seeds), max(seeds)])
    columns = ["claim", "column", "grade", "replicating", "counting", "least", "most"]
    return pd.DataFrame(rows, columns=columns).sort_values("claim", kind="stable", ignore_index=True)


def predictions(evidence: Mapping[str, Evidence]) -> pd.DataFrame:
    """Each of the paper's numbers, which is one run's, among our seeds (`stats.prediction`); evidence: by
    metric definition.
    """
    rows = []
    for definition, (configuration, metric) in itertools.product(
        evidence, itertools.product(paper.TABLES, paper.COLUMNS)
    ):
        number = paper.printed(*configuration, metric, definition == PER_FRAME)
        found = stats.prediction(evidence[definition](*configuration, metric), number)
        rows.append([*configuration, metric, definition, number, *found])
    columns = ["algorithm", "activation", "metric", "definition", "paper", *stats.Prediction._fields]
    return pd.DataFrame(rows, columns=columns)


def improvement(configurations: Configurations) -> pd.DataFrame:
    """For each pair of configurations, how probably a seed of the one beats a seed of the other
    (`stats.improvement`).
    """
    return stats.improvement(
        {name(*key): of_seeds(configuration, PRIMARY) for key, configuration in configurations.items()}
    )


def interactions(configurations: Configurations) -> pd.DataFrame:
    """Whether activations change places between the paper's algorithms: by metric and definition,
    `stats.interaction`.
    """
    rows = []
    for definition, metric in itertools.product((PRIMARY, SAMPLED), ("reward", "steps", "distance")):
        samples = {
            key: of_seeds(configuration, definition, metric)
            for key, configuration in configurations.items()
            if key in paper.TABLES
        }
        found = stats.interaction(long(samples))
        rows.append({"definition": definition, "metric": metric, **found._asdict()})
    return pd.DataFrame(rows)


def survival(
    configurations: Configurations, baselines: Mapping[str, pd.DataFrame]
) -> tuple[dict[str, pd.Series], pd.DataFrame]:
    """Kaplan-Meier curves of sampled episodes, all seeds together, and restricted means over seeds with
    intervals.
    """
    curves, rows = {}, []
    flown = {name(*key): episodes_of(configuration, SAMPLED) for key, configuration in configurations.items()}
    for label, part in {**flown, **baselines}.items():
        if part.empty:
            continue
        curves[label] = stats.survival(part["steps"].to_numpy(), part["terminated"].to_numpy())
        means = [
            stats.restricted_mean(one["steps"].to_numpy(), one["terminated"].to_numpy(), LIMIT)
            for _, one in part.groupby("seed")
        ]
        mean = stats.interval(means)
        rows.append([label, mean.n, len(part), part["truncated"].mean(), *mean[:3]])
    columns = ["configuration", "n", "episodes", "cut_off", "restricted_mean", "low", "high"]
    return curves, pd.DataFrame(rows, columns=columns)


def power(configurations: Configurations) -> pd.DataFrame:
    """Seeds a configuration that find the paper's difference in reward of two activations of an
    algorithm: 80 % power at 5 %.
    """
    rows = []
    for algorithm in algorithms(configurations):
        mine = {
            activation: configuration
            for (which, activation), configuration in paper_configurations(configurations).items()
            if which == algorithm
        }
        values = {activation: of_seeds(configuration, PRIMARY) for activation, configuration in mine.items()}
        for a, b in itertools.combinations(values, 2):
            n = min(len(values[a]), len(values[b]))
            first, second = (paper.printed(algorithm, one, "reward", PRIMARY == PER_FRAME) for one in (a, b))
            needed = stats.seeds_needed(values[a], values[b], first - second)
            rows.append({"pair": f"{algorithm.upper()}: {a} and {b}", "n": n, "seeds": needed})
    return pd.DataFrame(rows, columns=["pair", "n", "seeds"])


def flown(episodes: Mapping[tuple[str, str, str], pd.DataFrame]) -> pd.DataFrame:
    """What episodes of the main study look like, one row a configuration, mode and seed."""
    parts = [
        table.assign(configuration=name(algorithm, activation), algorithm=algorithm, activation=activation)
        for (study, algorithm, activation), table in episodes.items()
        if study == "main"
    ]
    columns = ["mode", "seed", "configuration", "algorithm", "activation"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def diagnostics(configurations: Configurations) -> pd.DataFrame:
    """The last tenth of training: mean over seeds and its interval of each diagnostic."""
    rows = []
    for key, configuration in configurations.items():
        progress = pd.concat([run.progress for run in configuration.runs], ignore_index=True)
        late = progress[progress["frame"] > 0.9 * configuration.settings["frames"]]
        for column in DIAGNOSTICS:
            if column in late:
                mean = stats.interval(late.groupby("seed")[column].mean())
                rows.append(
                    {"configuration": name(*key), "diagnostic": column, "n": mean.n, **mean._asdict()}
                )
    return pd.DataFrame(rows, columns=["configuration", "diagnostic", "n", "value", "low", "high"])


def compared(configurations: Iterable[Key]) -> dict[str, list[Key]]:
    """What a choice may flip: the mean reward of the first half of these configurations minus that of the
    second.
    """
    within = dict.fromkeys([*claims.ALGORITHMS, *algorithms(configurations)])
    between = {
        " above ".join(map(str.upper, claims.ALGORITHMS)): list(itertools.product(claims.ALGORITHMS, PAIR))
    }
    return between | {
        f"{one.upper()}: tanh above ReLU": list(itertools.product([one], PAIR)) for one in within
    }


def sensitivity(studies: Studies) -> pd.DataFrame:
    """Each conclusion under each switch, beside it as decided: columns switch, conclusion, value, low, high,
    n, flips.

    An algorithm that a switch does not touch is taken as decided. `flips`: the interval lies wholly on the
    other side of zero than it does as decided; `sign` if only the estimate does.
    """
    rows = []
    for switch, configurations in {AS_DECIDED: studies.baseline, **studies.switches}.items():
        for conclusion, keys in compared(studies.baseline).items():
            there = [configurations.get(key) or studies.baseline.get(key) for key in keys]
            if None in there or not any(key in configurations for key in keys):
                continue
            samples = [
                of_seeds(configuration, PRIMARY) for configuration in there if configuration is not None
            ]
            found = _first_minus_second(samples)
            rows.append({"switch": switch, "conclusion": conclusion, **found._asdict()})
    decided = {row["conclusion"]: row for row in rows if row["switch"] == AS_DECIDED}
    flips = [_flips(row, decided.get(row["conclusion"])) for row in rows]
    table = pd.DataFrame(rows, columns=["switch", "conclusion", "value", "low", "high", "n"])
    return table.assign(flips=flips)


def _first_minus_second(samples: Sequence[stats.Array]) -> stats.Interval:
    half = len(samples) // 2
    return stats.difference(samples[:half], samples[half:])


def _flips(row: Mapping[str, Any], decided: Mapping[str, Any] | None) -> str:
    if decided is None or decided is row:
        return ""
    if not decided["value"] * row["value"] < 0:
        return "no"
    clear = all(one["low"] * one["high"] > 0 for one in (decided, row))
    return "yes" if clear else "sign"


def one_run(values: pd.DataFrame) -> pd.DataFrame:
    """What one run a configuration, as the paper has, would say of reward: how often an activation would be
    the best of its algorithm, and how often all would stand in the paper's order.

    Columns algorithm, definition, what, share, n; values: as `per_seed_values` gives them.
    """
    rows = []
    chosen = values[(values["metric"] == "reward") & values["activation"].isin(paper.ACTIVATIONS)]
    chosen = chosen[chosen["definition"].isin(claims.COLUMNS.values())]
    for (algorithm, definition), part in chosen.groupby(["algorithm", "definition"], sort=False):
        seeds = {str(key): own.dropna().to_numpy() for key, own in part.groupby("activation")["value"]}
        printed = {
            one: paper.printed(str(algorithm), one, "reward", definition == PER_FRAME) for one in seeds
        }
        n = min(map(len, seeds.values()))
        if len(seeds) < len(paper.ACTIVATIONS) or not n or not all(np.isfinite([*printed.values()])):
            continue
        in_order = sorted(seeds, key=lambda one: -printed[one])
        shares = {f"{one} is best": stats.chance_of_best(seeds, one) for one in in_order}
        shares["the paper's order"] = stats.chance_of_order([seeds[one] for one in in_order])
        rows += [[algorithm, definition, what, share, n] for what, share in shares.items()]
    return pd.DataFrame(rows, columns=["algorithm", "definition", "what", "share", "n"])


def by_default(studies: Studies, winners: Configurations) -> pd.DataFrame:
    """PPO's reward minus DQN's with other settings and in the main study: columns settings, activations,
    value, low, high, n.

    The first two rows are of the activations that both algorithms have with the preset `fast`. winners: of
    trials; a row each for them, and for the lead with the preset minus theirs.
    """
    first, second = (
        [activation for which, activation in studies.tuned if which == one] for one in claims.ALGORITHMS
    )
    shared = [activation for activation in first if activation in second]
    fast, searched = (
        [of_seeds(own[key], SAMPLED) for key in itertools.product(claims.ALGORITHMS, names) if key in own]
        for own, names in ((studies.tuned, shared), (winners, ["tanh"]))
    )
    main = [
        of_seeds(studies.main[key], SAMPLED) if key in studies.main else np.empty(0)
        for key in itertools.product(claims.ALGORITHMS, shared)
    ]
    words = ", ".join(shared)
    rows = [[f"preset {claims.FAST}", words, *_first_minus_second(fast)]]
    rows.append(["main study", words, *_first_minus_second(main)])
    if shared and len(searched) == 2 and min(map(len, [*fast, *searched])) > 1:
        rows.append([claims.TUNED, "tanh", *_first_minus_second(searched)])
        weights = np.concatenate([[1, -1], [-1, 1]]).repeat([len(shared), len(shared), 1, 1])
        found = stats.welch([*fast, *searched], (weights / [*[len(shared)] * len(fast), 1, 1])[None])
        ends = [
            float(one[0]) for one in (found.value, found.lower(stats.TAILS[0]), found.upper(stats.TAILS[0]))
        ]
        rows.append([f"preset {claims.FAST} − {claims.TUNED}", words, *ends, min(map(len, fast))])
    return pd.DataFrame(rows, columns=["settings", "activations", *NUMBERS])


def speed(configurations: Configurations) -> pd.DataFrame:
    """Wall time of a million frames of one seed, by run: columns configuration, seconds, seeds, machine."""
    rows = []
    for key, configuration in configurations.items():
        for run, took in zip(timed(configuration), hours(configuration), strict=True):
            machine = run.meta.get("machine", {})
            processor = machine.get("processor", "not known") if isinstance(machine, dict) else str(machine)
            rows.append([name(*key), 3600 * took, len(run.seeds), processor])
    return pd.DataFrame(rows, columns=["configuration", "seconds", "seeds", "machine"])


def sizes(studies: Studies) -> pd.DataFrame:
    """How large each study is: columns study, algorithm, activation, seeds, frames (of a seed), worlds
    (of a seed).
    """
    named = {"main": studies.main, VECTORISED: studies.vectorised, "baseline": studies.baseline}
    named |= {"initial": studies.initial, **studies.switches, "tuned": studies.tuned}
    rows = [
        [
            study,
            *key,
            configuration.n_seeds,
            configuration.settings["frames"],
            configuration.settings["n_envs"],
        ]
        for study, found in named.items()
        for key, configuration in (paper_configurations(found) if study == "main" else found).items()
    ]
    return pd.DataFrame(rows, columns=["study", "algorithm", "activation", "seeds", "frames", "worlds"])


def gaps(configurations: Configurations, scripted: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Reward of test episodes, and its gap to the rule's on the same layouts: columns who, mode, limit, n and
    more.

    `up` is the share of episodes that the time limit [steps] ended, `above` the share of seeds above the
    rule. A gap is a mean over seeds of each seed's mean over layouts, with Student's 95 % interval over
    seeds; it is NaN without episodes of the rule on the same layouts and below the same time limit.
    `per_frame` is reward over steps, mean over seeds.
    """
    known = [(who, "", "scripted", table) for who, table in scripted.items()]
    known += [
        (name(*key), key[0], definition.split()[0], episodes_of(configuration, definition))
        for definition, (key, configuration) in itertools.product(EVALUATIONS, configurations.items())
    ]
    rule = finished(scripted[RULE]) if RULE in scripted else pd.DataFrame()
    rows = []
    for who, algorithm, mode, table in known:
        ended = finished(table)
        if ended.empty:
            continue
        by_seed = ended.groupby("seed")
        reward, sums = (
            stats.difference([by_seed["reward"].mean().to_numpy()], []),
            by_seed[["reward", "steps"]].sum(),
        )
        own = _to_rule(ended, rule) if who != RULE else np.empty(0)
        above = float((own > 0).mean()) if len(own) else np.nan
        facts = (_limit(ended), reward.n, len(ended), ended["truncated"].mean())
        per_frame = (sums["reward"] / sums["steps"]).mean()
        rows.append(
            [who, algorithm, mode, *facts, *reward[:3], per_frame, *stats.difference([own], [])[:3], above]
        )
    columns = [
        "who",
        "algorithm",
        "mode",
        "limit",
        "n",
        "episodes",
        "up",
        "reward",
        "low",
        "high",
        "per_frame",
    ]
    return pd.DataFrame(rows, columns=[*columns, "gap", "gap_low", "gap_high", "above"])


def passing(gaps: pd.DataFrame) -> pd.DataFrame:
    """How many seeds of an algorithm pass the scripted policy: columns algorithm, mode, passing, n; gaps: as
    `gaps` gives them.
    """
    learned = gaps[gaps["algorithm"] != ""]
    shares = learned[["above", "n"]].astype("float64")  # a table without rows has no types
    counted = learned.assign(passing=(shares["above"] * shares["n"]).round(), n=shares["n"])
    found = counted.groupby(["algorithm", "mode"], sort=False)[["passing", "n"]].sum()
    return found.astype("int64").reset_index()


def best(gaps: pd.DataFrame, mode: str, algorithm: str) -> Any:
    """Where the configuration of an algorithm with the highest reward stands in a table of `gaps`; None
    where there is none.
    """
    mine = gaps[(gaps["mode"] == mode) & (gaps["algorithm"] == algorithm)]
    return mine["reward"].idxmax() if len(mine) else None


def _limit(episodes: pd.DataFrame) -> float:
    """At how many steps episodes were cut off; NaN where none was."""
    return float(episodes.loc[episodes["truncated"], "steps"].max())


def _to_rule(episodes: pd.DataFrame, rule: pd.DataFrame) -> stats.Array:
    """Each seed's mean gap to the rule over the layouts that both flew [S]; none if their time limits
    differ.
    """
    if (
        rule.empty
        or not set(episodes["layout"]) <= set(rule["layout"])
        or abs(_limit(episodes) - _limit(rule)) > 0
    ):
        return np.empty(0)  # a time limit that ended no episode is NaN
    of_rule = episodes["layout"].map(rule.groupby("layout")["reward"].mean())
    return (episodes["reward"] - of_rule).groupby(episodes["seed"]).mean().to_numpy()


def effects(studies: Studies) -> pd.DataFrame:
    """What a setting changes in an algorithm's reward per frame: columns switch, algorithm, frames, and
    `NUMBERS`.

    The mean over the activations that both have, minus that as decided; many environments minus one. frames:
    a seed.
    """
    pairs = [
        (switch, configurations, studies.baseline) for switch, configurations in studies.switches.items()
    ]
    pairs.append((VECTORISED, paper_configurations(studies.vectorised), paper_configurations(studies.main)))
    rows = []
    for switch, changed, usual in pairs:
        shared = [key for key in changed if key in usual]
        for algorithm in dict.fromkeys(which for which, _ in shared):
            keys = [key for key in shared if key[0] == algorithm]
            first, second = (
                [of_seeds(configurations[key], PRIMARY) for key in keys]
                for configurations in (changed, usual)
            )
            frames = max(changed[key].settings["frames"] for key in keys)
            rows.append([switch, algorithm, frames, *stats.difference(first, second)])
    return pd.DataFrame(rows, columns=["switch", "algorithm", "frames", *NUMBERS])


def one_against_many(studies: Studies) -> pd.DataFrame:
    """What one environment a seed changes beside the mean, against many: columns measure, algorithm, and
    `NUMBERS`.

    One minus many, mean over the activations that both studies have, with Welch's interval over seeds:

    - scatter: the standard deviation over seeds of reward per frame in the last 100,000 frames
      (`stats.deviations`);
    - longest: the longest episode of a seed that is open at the end [steps], 0 where none is;
    - open: the share of a seed's frames in episodes that are open at the end.

    order: Spearman's correlation, one against many, of the activations' mean rewards per frame.
    """
    one, many = paper_configurations(studies.main), paper_configurations(studies.vectorised)
    shared, rows = [key for key in one if key in many], []
    for algorithm in dict.fromkeys(which for which, _ in shared):
        pairs = [
            [configurations[key] for key in shared if key[0] == algorithm] for configurations in (one, many)
        ]
        for measure, of in {"scatter": _scatter, "longest": _longest, "open": _open}.items():
            first, second = (
                [of(configuration) for configuration in configurations] for configurations in pairs
            )
            rows.append([measure, algorithm, *stats.difference(first, second)])
        first, second = (
            [of_seeds(configuration, PRIMARY) for configuration in configurations] for configurations in pairs
        )
        rows.append(["order", algorithm, *stats.rank_correlation(first, second)])
    return pd.DataFrame(rows, columns=["measure", "algorithm", *NUMBERS])


def _scatter(configuration: Configuration) -> stats.Array:
    frames = configuration.settings["frames"]
    return stats.deviations(windowed(configuration, "reward", [(frames - AFTER, frames)])[0].to_numpy())


def _longest(configuration: Configuration) -> stats.Array:
    return np.asarray(_open_episodes(configuration).max(), dtype=np.float64)


def _open(configuration: Configuration) -> stats.Array:
    return np.asarray(_open_episodes(configuration).sum() / configuration.settings["frames"])


def _open_episodes(configuration: Configuration) -> Any:
    """Steps of episodes that are open at the end, 0 for all others, by seed."""
    ended = configuration.episodes["terminated"] | configuration.episodes["truncated"]
    return configuration.episodes["steps"].where(~ended, 0).groupby(configuration.episodes["seed"])


def carried(studies: Studies, evidence: Evidence) -> pd.DataFrame:
    """What is said of activations, by algorithm, in many environments: columns conclusion, algorithm, value,
    ...

    None unless an algorithm beyond the paper's has runs with the activations that some conclusion asks for.
    """
    study = "vectorised"
    there = sorted(studies.of(study), key=order)
    algorithms = list(dict.fromkeys(algorithm for algorithm, _ in there))
    rows = []
    for (label, sides), algorithm in itertools.product(CONCLUSIONS.items(), algorithms):
        first, second = (
            [evidence(algorithm, activation, "reward", study=study) for activation in side] for side in sides
        )
        if all(len(one) for one in (*first, *second)):
            rows.append([label, algorithm, *stats.difference(first, second)])
    found = pd.DataFrame(rows, columns=["conclusion", "algorithm", "value", "low", "high", "n"])
    return found if {*found["algorithm"]} - {*paper.TABLE_OF} else found[:0]


def peaks(configurations: Configurations, log: Evidence) -> pd.DataFrame:
    """When a configuration earns most per frame, and what it loses after 600,000 frames: columns
    configuration, measure, and `NUMBERS`.

    `peak` is the middle of each seed's best stretch of training [frames]; `lost` the share of the rise in
    reward per frame, from the first 300,000 frames to the next, that is gone in the last 100,000 (Fieller's
    interval). The same by SB3's log (reward per episode), its means in these stretches, and how many seeds
    lose more than half. log: the evidence of that definition.
    """
    rows = []
    for key, configuration in configurations.items():
        frames = configuration.settings["frames"]
        if frames < SURGE[1] + AFTER:
            continue
        # of equal ones the first
        best = np.asarray(curve(configuration, "reward").round(9).idxmax(), dtype=np.float64)
        before, surge, after = (
            windowed(configuration, "reward", [(0, SURGE[0]), SURGE, (frames - AFTER, frames)]).to_numpy().T
        )
        rows += [
            [name(*key), "peak", *stats.difference([best], [])],
            [name(*key), "lost", *stats.ratio(surge - after, surge - before)],
        ]
        logged = {when: log(*key, f"reward_{when}") for when in ("before", "surge", "after")}
        rows += [[name(*key), f"{when}, {SB3}", *stats.difference([one], [])] for when, one in logged.items()]
        before, surge, after = logged.values()
        halved = int((surge - after > (surge - before) / 2).sum())
        rows.append([name(*key), f"lost, {SB3}", *stats.ratio(surge - after, surge - before)])
        rows.append([name(*key), f"seeds that lose half, {SB3}", halved, np.nan, np.nan, len(after)])
    return pd.DataFrame(rows, columns=["configuration", "measure", *NUMBERS])


def fits(predictions: pd.DataFrame, evidence: Mapping[str, Evidence]) -> pd.DataFrame:
    """How well the paper's numbers fit our prediction intervals: columns definition, configuration, within,
    numbers, score, p, farther.

    Of so many numbers, so many lie within. A wide interval holds any number, so the score of a 95 % interval
    (Gneiting and Raftery 2007, eq. 43) is its width plus 2 / 0.05 times how far it misses the number; the
    mean over numbers, each score in units of the paper's number. Less is better.

    p, farther: of a configuration's six numbers as one seed (`stats.joint`): its p value, and the share of
    our seeds that the paper's run lies farther out than. predictions: as `frames.predictions` gives it;
    numbers without seeds are left out; evidence: by metric definition.
    """
    known = predictions[predictions["n"] > 1]
    low, high, number = (known[name] for name in ("low", "high", "paper"))
    missed = (low - number).clip(lower=0) + (number - high).clip(lower=0)
    score = (high - low + 2 / 0.05 * missed) / number.abs()
    named = known.assign(
        configuration=known["algorithm"].str.upper() + " " + known["activation"], score=score
    )
    counted = []
    for definition, own in named.groupby("definition", sort=False):
        for configuration, part in [(EVERY, own), *own.groupby("configuration", sort=False)]:
            joint: tuple[float, ...] = (np.nan, np.nan)
            if configuration != EVERY:
                one = part.iloc[0]
                key = one["algorithm"], one["activation"]
                seeds = [evidence[str(definition)](*key, metric) for metric in part["metric"]]
                if len({*map(len, seeds)}) == 1:
                    joint = stats.joint(np.stack(seeds, 1), part["paper"].to_numpy())
            facts = int(part["within"].sum()), len(part), part["score"].mean()
            counted.append((definition, configuration, *facts, *joint))
    columns = ["definition", "configuration", "within", "numbers", "score", "p", "farther"]
    return pd.DataFrame(counted, columns=columns)


def baselines(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows of scripted policies and of people: `baselines/*.parquet` in the report's folders; what cannot
    be read.
    """
    found, left_out = {}, []
    for path in (path for folder in folders for path in sorted((folder / "baselines").glob("*.parquet"))):
        try:
            found[path.stem] = read_table(path, EVALUATED, "evaluate it again")
        except RunError as error:
            left_out.append(str(error))
    return found, left_out


def total_frames(configurations: Configurations) -> str:
    """How many frames a seed has: one number, or from ... to ..."""
    return least_to_most(configuration.settings["frames"] for configuration in configurations.values())


def worlds(configurations: Configurations) -> str:
    """How many parallel environments a seed has: one number, or from ... to ..."""
    return least_to_most(configuration.settings["n_envs"] for configuration in configurations.values())


def least_to_most(counts: Iterable[int], noun: str = "") -> str:
    """The range of some counts, one number where they are the same; and of what, in the plural unless
    there is one.
    """
    ordered = sorted({*counts})
    shown = " to ".join(f"{count:,}" for count in dict.fromkeys([*ordered[:1], *ordered[-1:]])) or "0"
    return f"{shown} {noun}{'s' * (ordered != [1])}" if noun else shown
