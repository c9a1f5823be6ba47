"""The findings as plain sentences: each has one number with its interval, and names the row of a table that holds it.

All is made from the report's tables. The words follow the intervals, and a finding without numbers is left out.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.report import frames, tables
from uavnav.report.claims import ALGORITHMS, CLAIMS, NAMES, PRIMARY, Claim
from uavnav.report.headline import EVERY, MANY_WORLDS, RULE
from uavnav.report.verdicts import ABSENT, CONTEXT, DOES_NOT, IN_PART, OPEN, REPLICATES, Grade
from uavnav.report.whys import Question
from uavnav.runs import paper
from uavnav.runs.metrics import MODES
from uavnav.runs.readings import ALL, LAST_EPISODES, LOG_CURVE, PER_FRAME, TOTALS
from uavnav.runs.trials import DIFFERENCE, HOW, TUNED
from uavnav.stats import Interval

Numbers = Mapping[str, pd.DataFrame]
"""The report's tables, by the name of their CSV."""
AHEAD = {
    1: ("PPO", "DQN"),
    2: ("PPO with tanh", "PPO's best other activation"),
    3: ("DQN with sigmoid", "DQN's best other activation"),
    8: ("the mean of PPO's other activations", "PPO with sigmoid"),
}
"""Who leads whom in the paper, by the claim whose part says so (`Claim.said`)."""
SURGES = "DQN sigmoid"
READ_AS = {
    PER_FRAME: "means per frame",
    LOG_CURVE: "means of Stable-Baselines3's log",
    ALL: "means of all episodes",
    TOTALS: "ratios of totals",
    LAST_EPISODES: "means of the last episodes",
}
"""The readings of training, as one reads the paper's tables."""
TALLIED = {
    REPLICATES: ("replicates", "replicate"),
    IN_PART: ("does in part", "do in part"),
    DOES_NOT: ("does not", "do not"),
    OPEN: ("is open", "are open"),
    CONTEXT: ("is of computing time", "are of computing time"),
}
"""A claim's grade as the verb of one claim, and of several."""
WHO = {RULE: f"a hand-written rule (`{RULE}`)"}


UNITS = {"reward": 1000, "corridor": 100}
"""Frames, or steps, of which sentences tell a measure."""
WORLDS = {
    "scatter": (
        "WHO's seeds scatter by {} more late reward in 1,000 frames in one world than in many.",
        "WHO's seeds scatter by {} less late reward in 1,000 frames in one world than in many.",
        "One world and many are not told apart in the scatter of WHO's seeds: {} of late reward in 1,000 frames.",
    ),
    "longest": (
        "A WHO seed's longest open flight is {} steps longer in one world than in many.",
        "A WHO seed's longest open flight is {} steps shorter in one world than in many.",
        "One world and many are not told apart in the longest open flight of a WHO seed: {} steps.",
    ),
    "open": (
        "Flights open at the end hold {} more of WHO's frames in one world than in many.",
        "Flights open at the end hold {} less of WHO's frames in one world than in many.",
        "One world and many are not told apart in the share of WHO's frames in open flights: {}.",
    ),
    "order": (
        "WHO's activations keep nearly the same order in one world and many: ranks correlate by {}.",
        "WHO's activations turn their order round in many worlds: ranks anticorrelate by {}.",
        "It is open whether WHO's activations keep their order in one world and many: ranks correlate by {}.",
    ),
}
"""What one world a seed changes beside the mean, by the measure of `headline.worlds`: more, less, or not told apart."""
SHOWN_AS = {"scatter": (1000.0, ""), "open": (100.0, " %")}
"""By how much such a measure is multiplied, and its unit."""


class Sentence(NamedTuple):
    """A sentence around the number that a row of a table holds."""

    before: str
    number: str
    after: str
    table: str  # the name of its CSV
    row: int | None  # its place in the table, from 0; None for all of them

    def __str__(self) -> str:
        return f"{self.before}{self.number}{self.after}"

    def link(self) -> str:
        """The row, from the folder of results: its line in the CSV, after that of the header."""
        return f"tables/{self.table}.csv" + (f"#L{self.row + 2}" if self.row is not None else "")

    def markdown(self, root: str = "") -> str:
        """With the number as a link; root: the folder of results, with a slash."""
        return f"{self.before}[{self.number}]({root}{self.link()}){self.after}" if self.number else str(self)


def findings(numbers: Numbers) -> list[Sentence]:
    """What the study found: how many claims hold, the rule, who is ahead, targets, times, readings."""
    makers = (_tally, _rule, _ahead, _one_step, _surge, _fit)
    return [sentence for make in makers for sentence in make(numbers)]


def more_worlds(numbers: Numbers) -> list[Sentence]:
    """What more worlds a seed change: the reward, the scatter of seeds, open flights, the order of activations."""
    return [*_many_worlds(numbers), *_worlds(numbers)]


def tuned(numbers: Numbers) -> list[Sentence]:
    """What the same budget of tuning changes: who leads whom, each algorithm's reward, the gap to the rule."""
    return [*_pair(numbers), *_tuned(numbers), *_gap(numbers)] if "tuning" in numbers else []


def why(numbers: Numbers, question: Question) -> list[Sentence]:
    """What answers a question to the side studies: a sentence for each of its contrasts with words."""
    found: list[Sentence] = []
    for contrast in question.contrasts:
        for place, row in _rows(numbers["whys"], row=contrast.name, metric=contrast.metric):
            if contrast.said:
                found += _told(*contrast.said, _times(_found(row), UNITS.get(contrast.metric, 1)), "whys", place)
    return found


def headline(numbers: Numbers) -> Sentence:
    """The one sentence of a report: who flies best of PPO, DQN and the rule, or else the first finding there is."""
    for place, row in _best(numbers["gaps"], MODES[1:]):
        gap, ahead = Interval(row.gap, row.gap_low, row.gap_high, row.n), _part(numbers, CLAIMS[0])[1]
        if row.algorithm == ALGORITHMS[0] and gap.high < 0 < ahead.low:
            before = "PPO beats DQN, as the paper says, but a hand-written rule beats PPO by "
            return Sentence(before, between(_times(gap, -1)), " of reward a flight.", "gaps", place)
    title = "DQN against PPO, four activation functions: what holds of the paper"
    return next(iter([*_rule(numbers), *_tally(numbers)]), Sentence(title, "", "", "verdicts", None))


def of_sections(numbers: Numbers) -> dict[str, Sentence]:
    """What each section of the page comes to in a sentence, by its id; a section without numbers has none."""
    by_number = {claim.number: claim for claim in CLAIMS}
    makers = {
        "tables": _fit(numbers),
        "curves": _surge(numbers),
        "flights": _up(numbers),
        "statistics": _ahead(numbers),
        "behaviour": iter([of_claim(numbers, by_number[9])]),
        "why": _one_step(numbers),
        "sensitivity": _flips(numbers),
        "baselines": _rule(numbers),
        "algorithms": iter(tuned(numbers)[1:]),
        "speed": iter([of_claim(numbers, by_number[11])]),
        "methods": iter([study(numbers)]),
    }
    return {section: first for section, made in makers.items() if (first := next(made, None))}


def _up(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _best(numbers["gaps"], MODES[1:]):
        if not np.isnan(row.cap):
            after = f" of the test flights of {_with(row.who)} last {row.cap:,.0f} steps."
            yield Sentence("", f"{row.up:.0%}".replace("%", " %"), after, "gaps", place)


def _flips(numbers: Numbers) -> Iterator[Sentence]:
    asked = numbers["sensitivity"].query("flips != ''")
    if len(asked):
        after = f" of {len(asked)} comparisons turns round where a choice that the paper leaves open is changed."
        yield Sentence("", str((asked["flips"] == "yes").sum()), after, "sensitivity", None)


def between(found: Interval, unit: str = "") -> str:
    """A number and its interval in plain words; the number alone where it has none. Shares and hundreds are whole."""
    places = 0 if unit or abs(found.value) > 100 else tables.digits(found)
    value, low, high = (tables.number(round(one, places) + 0.0, places) for one in found[:3])  # no −0
    return value + unit if np.isnan(found.low) else f"{value}{unit} ({low} to {high}{unit})"


def _times(found: Interval, factor: float) -> Interval:
    low, high = sorted((factor * found.low, factor * found.high))
    return Interval(factor * found.value, low, high, found.n)


def _found(row: Any) -> Interval:
    return Interval(row.value, row.low, row.high, row.n)


def _rows(table: pd.DataFrame, **where: Any) -> Iterator[tuple[int, Any]]:
    """The places and the rows where columns have these values."""
    for place, row in enumerate(table.itertuples(index=False)):
        if all(getattr(row, column) == value for column, value in where.items()):
            yield place, row


def _told(
    above: str, below: str, neither: str, found: Interval, table: str, row: int, unit: str = ""
) -> Iterator[Sentence]:
    """One of three sentences, by where the interval lies to zero; none without an interval. {} is for the number."""
    if np.isnan(found.low):
        return
    words = above if found.low > 0 else below if found.high < 0 else neither
    shown = between(_times(found, -1) if found.high < 0 else found, unit)
    before, after = words.split("{}")
    yield Sentence(before, shown, after, table, row)


def study(numbers: Numbers) -> Sentence:
    """How large the study is that answers for the paper, and in how many worlds a seed learned."""
    cells = numbers["cells"].query("study == 'main'")
    seeds, long = frames.least_to_most(cells["seeds"], "seed"), frames.least_to_most(cells["frames"])
    worlds = frames.least_to_most(cells["worlds"])
    usual = "one world at a time, the default of Stable-Baselines3"
    known = usual if worlds == "1" else f"{worlds} parallel worlds (one is the default of Stable-Baselines3)"
    cell = "Each cell (algorithm and activation) has "
    return Sentence(cell, f"{seeds} of {long} frames", f", each seed in {known}.", "cells", None)


def _tally(numbers: Numbers) -> Iterator[Sentence]:
    primary = numbers["verdicts"].query("reading == @PRIMARY and n > 0").drop_duplicates("claim")
    counts = Counter(primary["grade_of_claim"].str.split(" (", regex=False).str[0])
    if len(primary):
        told = {kind: f"{n} {TALLIED[kind][int(n != 1)]}" for kind, n in counts.items()}
        first, *others = [told[kind] for kind in TALLIED if kind in told]
        after = "".join(f", {one}" for one in others[:-1]) + "".join(f" and {one}" for one in others[-1:])
        yield Sentence(f"Of the paper's {len(CLAIMS)} claims, ", first, f"{after}.", "verdicts", None)


def _ahead(numbers: Numbers) -> Iterator[Sentence]:
    for claim in (claim for claim in CLAIMS if claim.number in AHEAD):
        first, second = AHEAD[claim.number]
        place, row = _part(numbers, claim)
        percent = _times(Interval(row.ratio, row.ratio_low, row.ratio_high, row.n), 100)
        leads = f"In the paper, {first} leads {second};"
        less = "here by less than half of that: {}."
        yield from _told(
            f"{_upper(first)} leads {second}, by {{}} of its lead in the paper.",
            f"{leads} here it trails, by {{}} of that lead.",
            f"{leads} {less if row.verdict == ABSENT else 'here not told apart: {} of that lead.'}",
            *(percent, "verdicts", place, " %"),
        )


def _upper(words: str) -> str:
    return words[:1].upper() + words[1:]


def _one_step(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _rows(numbers["effects"]):
        name, _, steps = row.switch.partition("=")
        if name == "n_steps":
            who = row.algorithm.upper()
            where, targets = f"In a side study of {row.n:.0f} seeds, {who}", f"learning from one step than from {steps}"
            yield from _told(
                f"{where} earns {{}} less reward in 1,000 frames {targets}.",
                f"{where} earns {{}} more reward in 1,000 frames {targets}.",
                f"{who} learning from one step or from {steps} is not told apart: {{}} of reward in 1,000 frames.",
                *(_times(_found(row), 1000), "effects", place),
            )


def _surge(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _rows(numbers["peaks"], cell=SURGES, measure="peak"):
        value, low, high = (round(one, -3) for one in _found(row)[:3])
        shown = between(Interval(value, low, high, row.n))
        yield Sentence("DQN with sigmoid earns most at frame ", shown, ".", "peaks", place)
    for place, row in _rows(numbers["peaks"], cell=SURGES, measure="lost"):
        yield from _told(
            "By the end, DQN with sigmoid has lost {} of what it had gained.",
            "DQN with sigmoid gains on until the end, by {} of what it had gained.",
            "By the end, DQN with sigmoid is not seen to have lost: {} of what it had gained.",
            *(_times(_found(row), 100), "peaks", place, " %"),
        )


def _fit(numbers: Numbers) -> Iterator[Sentence]:
    fits = numbers["fits"]
    training = fits[fits["reading"].isin(list(READ_AS))]
    every = training[training["cell"] == EVERY]
    if every.empty or every["numbers"].max() < len(paper.COLUMNS) * len(paper.TABLES):
        return
    best = every.loc[every["score"].idxmin()]
    shown, within = f"{best['within']} of {best['numbers']}", " lie where 95 % of our single seeds would."
    before = f"The paper's numbers look most like {READ_AS[str(best['reading'])]}: "
    yield Sentence(before, shown, within, "fits", int(every["score"].idxmin()))
    cells = training[(training["reading"] == best["reading"]) & (training["cell"] != EVERY)]
    least = cells[cells["within"] == cells["within"].min()]
    first = least.iloc[0]
    if first["within"] < first["numbers"]:
        names = " and ".join(map(_with, least["cell"])) if len(least) < 3 else f"{len(least)} cells"
        shown, each = f"{first['within']} of {first['numbers']}", " each" * (len(least) > 1)
        chosen = f"{each}; this reading was chosen after the runs."
        verb = "fit is" if len(least) == 1 else "fits are"
        yield Sentence(f"The worst {verb} {names}: ", shown, chosen, "fits", int(least.index[0]))


def _rule(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _best(numbers["gaps"], MODES[1:]):
        best = f"the best sampled policy, {_with(row.who)}"
        yield from _told(
            f"{_upper(best)}, earns {{}} more on a test flight than a hand-written rule.",
            f"A hand-written rule earns {{}} more on a test flight than {best}.",
            f"A hand-written rule and {best}, are not told apart: {{}} of reward a test flight.",
            *(Interval(row.gap, row.gap_low, row.gap_high, row.n), "gaps", place),
        )


def _many_worlds(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _rows(numbers["effects"], switch=MANY_WORLDS):
        who = row.algorithm.upper()
        yield from _told(
            f"{who} earns {{}} more reward in 1,000 frames in many worlds a seed than in one.",
            f"{who} earns {{}} less reward in 1,000 frames in many worlds a seed than in one.",
            f"{who} in many worlds a seed is not told apart from {who} in one: {{}} of reward in 1,000 frames.",
            *(_times(_found(row), 1000), "effects", place),
        )


def _pair(numbers: Numbers) -> Iterator[Sentence]:
    chain = ("PPO", "DQN"), ("DQN", "SAC")  # the paper's related work has SAC above DQN above PPO
    for (which, how), (first, second) in itertools.product(HOW.items(), chain):
        for place, row in _rows(numbers["tuning_pairs"], pair=f"{first} − {second}".lower(), settings=which):
            yield from _told(
                f"{how}, {first} earns {{}} more a test flight than {second}.",
                f"{how}, {first} earns {{}} less a test flight than {second}.",
                f"{how}, {first} and {second} are not told apart: {{}} of reward a test flight.",
                *(_found(row), "tuning_pairs", place),
            )


def _tuned(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _rows(numbers["tuning"], settings=DIFFERENCE):
        who = row.algorithm.upper()
        yield from _told(
            f"Tuned, {who} earns {{}} more a test flight than with its defaults.",
            f"Tuned, {who} earns {{}} less a test flight than with its defaults.",
            f"Tuned, {who} is not told apart from its defaults: {{}} of reward a test flight.",
            *(_found(row), "tuning", place),
        )


def _gap(numbers: Numbers) -> Iterator[Sentence]:
    known = [(place, row) for place, row in _rows(numbers["tuning"], settings=TUNED) if not np.isnan(row.gap)]
    for place, row in sorted(known, key=lambda found: -found[1].gap)[:1]:
        who = row.algorithm.upper()
        yield from _told(
            f"{who}, tuned, passes the hand-written rule by {{}} of reward a test flight.",
            f"None passes the hand-written rule; {who} comes nearest, {{}} of reward a test flight behind.",
            f"It is open whether {who}, tuned, passes the hand-written rule: {{}} of reward a test flight.",
            *(Interval(row.gap, row.gap_low, row.gap_high, row.n), "tuning", place),
        )


def _worlds(numbers: Numbers) -> Iterator[Sentence]:
    for place, row in _rows(numbers["worlds"]):
        factor, unit = SHOWN_AS.get(row.measure, (1.0, ""))
        more, less, neither = (words.replace("WHO", row.algorithm.upper()) for words in WORLDS[row.measure])
        yield from _told(more, less, neither, _times(_found(row), factor), "worlds", place, unit)


def _best(gaps: pd.DataFrame, modes: tuple[str, ...], algorithms: tuple[str, ...] = ()) -> Iterator[tuple[int, Any]]:
    """The place and the row of the learned cell with the highest reward on test flights, if there is one."""
    learned = gaps[gaps["mode"].isin(list(modes)) & (gaps["algorithm"].isin(list(algorithms)) | (not algorithms))]
    if len(learned):
        place = int(learned["reward"].idxmax())
        yield place, next(gaps.iloc[[place]].itertuples(index=False))


def _with(label: str) -> str:
    """A cell's label in words: PPO with leaky ReLU."""
    algorithm, _, activation = label.partition(" ")
    return f"{algorithm} with {NAMES.get(activation, activation)}"


def shown_first(numbers: Numbers) -> dict[str, str]:
    """Who flies on the first screen: the best cell of each of the paper's algorithms, the better first, in words."""
    best = [one for algorithm in paper.TABLE_OF for one in _best(numbers["gaps"], MODES[1:], (algorithm,))]
    return {row.who: _with(row.who) for _, row in sorted(best, key=lambda one: -one[1].reward)}


def beside_flights(numbers: Numbers, shown: dict[str, Any]) -> str:
    """What must be known of the flights on the first screen, as `replays.together` gives them."""
    cut = [one["steps"] for drone in shown["drones"] for one in drone["flights"] if one["ended"] == "cut off"]
    rule, best = next(_rows(numbers["gaps"], who=RULE), None), next(_best(numbers["gaps"], MODES[1:]), None)
    limit = f" of at most {rule[1].cap:,.0f}" if rule and not np.isnan(rule[1].cap) else ""
    where = "Obstacles are new to every policy"
    said = f"The first {max(cut):,} steps{limit}. {where}." if cut else f"{where}."
    stays = rule and best and best[1].gap_high < 0 and best[1].up < rule[1].up
    return f"{said} The rule wins by flying on." if stays else said


def flights(numbers: Numbers, root: str = "") -> tables.Rows:
    """Test flights of the rule and of each algorithm's best cell: reward, its gap to the rule, share still up."""
    gaps = numbers["gaps"]
    rows = [["test flights", "reward", "gap to the rule", "still flying at the limit"]]
    best = [one for algorithm in paper.TABLE_OF for mode in MODES for one in _best(gaps, (mode,), (algorithm,))]
    for place, row in sorted([*_rows(gaps, who=RULE), *best], key=lambda one: -one[1].reward):
        who = WHO.get(row.who) or f"{_with(row.who)}, {row.mode}"
        reward = Sentence("", between(Interval(row.reward, row.low, row.high, row.n)), "", "gaps", place)
        gap = between(Interval(row.gap, row.gap_low, row.gap_high, row.n))
        rows.append([who, reward.markdown(root), gap, f"{row.up:.0%}"])
    return rows


def _part(numbers: Numbers, claim: Claim) -> tuple[int, Any]:
    """The place and the row of the part that a claim's sentence is about, in the primary reading."""
    text = claim.parts[claim.said.part].text
    return next(_rows(numbers["verdicts"], reading=PRIMARY, claim=claim.number, text=text))


def of_claim(numbers: Numbers, claim: Claim) -> Sentence:
    """A claim's plain sentence: how much more or less there is, and in the paper."""
    place, row = _part(numbers, claim)
    if not row.n:
        return Sentence("No finished run.", "", "", "verdicts", place)
    said, found = claim.said, _times(_found(row), claim.said.scale)
    digits = tables.digits(found)

    def word(value: float) -> str:
        chosen = said.up if value >= 0 else said.down
        return f" {chosen}" if chosen else ""

    own = said.scale * row.paper
    shown = tables.number(abs(own), digits if abs(own) < 1 else min(digits, 1))
    printed = "" if np.isnan(own) else f"; in the paper, {shown}{word(own)}"
    number = between(_times(found, -1) if found.value < 0 else found)
    before, after = (said.sentence or f"{row.text}: {{}}").split("{}")
    return Sentence(before, number, f"{word(found.value)}{after}{printed}.", "verdicts", place)


def claims(numbers: Numbers, grades: Mapping[int, Grade], root: str = "") -> tables.Rows:
    """A row a claim: its sentence in the paper, its grade with a bar of its parts, and ours."""
    rows = [["", "the paper says", "grade", "our seeds say"]]
    for claim in CLAIMS:
        graded = f"{tables.bar(grades[claim.number])} {grades[claim.number]}"
        rows.append([str(claim.number), claim.sentence, graded, of_claim(numbers, claim).markdown(root)])
    return rows


def against_itself(numbers: Numbers, root: str = "") -> tables.Rows:
    """The parts of claims that the paper's own tables, as printed, do not show: they should be above zero."""
    rows = [["claim", "what it says", "the paper's own tables"]]
    for place, row in _rows(numbers["verdicts"], reading=ALL):
        if row.paper <= 0:
            number = Sentence("", tables.number(row.paper), "", "verdicts", place)
            rows.append([str(row.claim), row.text, number.markdown(root)])
    return rows
