"""Operating characteristics of the rule: how often a claim would be graded what, if we knew the truth.

Letters: D simulated studies, S seeds of a configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from uavnav.report.claims import CLAIMS, Claim, Evidence, Part, Term
from uavnav.report.frames import Rows, columns
from uavnav.report.verdicts import GRADES, effects, judge
from uavnav.stats import Array

STUDIES = 1_000
TRUTHS = TABLES, EQUAL = "the paper's tables", "no difference"
"""The paper's tables are the truth; or whatever the claim compares is equal (`Claim.equal`)."""


@columns("claim", "truth", "grade", "share")
def characteristics(evidence: Evidence, paper: Evidence, claims: Sequence[Claim] = CLAIMS) -> Rows:
    """How often each claim would be graded what; shares are of `STUDIES`.

    A simulated study has our configurations' numbers of seeds, and seeds that scatter as ours do: residuals
    around our configurations' means, drawn with replacement and times sqrt(S / (S - 1)), are added to the
    true means. A seed's metrics are drawn together. Claims without a part to judge, without seeds, or (of the
    paper's tables) without printed numbers are left out.
    """
    for claim in claims:
        parts = [part for part in claim.parts if not part.beside]
        seeds = {term: evidence(*term) for part in parts for term in part.terms}
        if not parts or not any(map(len, seeds.values())):
            continue
        printed = [effects(part, paper) for part in parts]
        for truth in TRUTHS:
            means = _means(claim, seeds, paper, truth)
            if not np.isfinite(list(means.values())).all():
                continue
            rng = np.random.default_rng((0, claim.number))
            judged = judge(parts, _studies(parts, seeds, means, rng), printed)
            for grade in GRADES[:-1]:
                yield claim.number, truth, grade, float((judged.grades == grade).mean())


def _means(claim: Claim, seeds: Mapping[Term, Array], paper: Evidence, truth: str) -> dict[Term, float]:
    """The true mean of every term that has seeds; NaN where the paper's tables have no number."""
    known = {term: own for term, own in seeds.items() if len(own)}
    printed = {term: numbers.mean() if len(numbers := paper(*term)) else np.nan for term in known}
    if truth == TABLES:
        return printed
    groups: dict[tuple[str, ...], list[float]] = {}
    keys = {term: tuple(getattr(term, field) for field in claim.equal) for term in known}
    for term, key in keys.items():
        own = printed[term]
        groups.setdefault(key, []).append(known[term].mean() if np.isnan(own) else own)
    return {term: float(np.mean(groups[key])) for term, key in keys.items()}


def _studies(
    parts: Sequence[Part], seeds: Mapping[Term, Array], means: Mapping[Term, float], rng: np.random.Generator
) -> list[list[Array]]:
    """Simulated seeds of each part's terms, each [D, S]; a configuration's metrics are drawn together."""
    drawn: dict[object, np.ndarray[Any, np.dtype[np.int64]]] = {}

    def simulated(part: Part, term: Term) -> Array:
        own = seeds[term]
        if len(own) < 2:
            return np.empty((STUDIES, len(own)))
        together = (part if part.paired else (term.algorithm, term.activation, term.study), len(own))
        if together not in drawn:
            drawn[together] = rng.integers(len(own), size=(STUDIES, len(own)))
        residuals = (own - own.mean()) * np.sqrt(len(own) / (len(own) - 1))
        return np.asarray(means[term] + residuals[drawn[together]])

    return [[simulated(part, term) for term in part.terms] for part in parts]
