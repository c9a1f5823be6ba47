"""What the study says, in sentences made from its findings: no adjective without an interval."""

from __future__ import annotations

import math
from collections.abc import Sequence

from uavnav.evaluate import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.report import tables
from uavnav.report.claims import (
    CLAIMS,
    CONTRADICTED,
    PRIMARY,
    SEEDS,
    SUPPORTED,
    UNDECIDED,
    Claim,
    Finding,
    p_shown,
    verdict,
)

RULE = (
    "A part of a claim is supported or contradicted only if the "
    "95 % bootstrap interval over training seeds, adjusted by Holm for all parts of all claims, lies wholly "
    f"inside or outside the claimed region, with at least {SEEDS} seeds in every cell; else it is undecided. A "
    f"claim is contradicted if one of its parts is, supported if all are. The primary reading is {PRIMARY}; the "
    "others stand beside it."
)
FIXED = (
    "The rule's code is of commit 8c7dc96, written after a pilot of three seeds a cell had been read and while the "
    "study's first runs were under way; paired resampling for claim 4's times, the levels after the first failure of "
    "Holm, and claim 9's share of the distance flown were added while runs were under way and before their results "
    "were read. After results had been read, on 2026-11-21, claim 8's test, which rejected equal orders at unequal "
    f"noise, gave way to one of crossovers ({PRIMARY}: undecided under both, Holm's p 0.41 and 1; last 100: supported "
    "under the old one, undecided under the new), and claim 11 came to count seeds instead of runs."
)
BEHAVIOUR = (
    f"Flights of at most {WATCHED_STEPS} steps on {WATCHED_LAYOUTS} test sets, acting as in training. A drone is in a"
    " corridor where two bodies (circles or walls) are within 120 px of its centre in directions at least 120° apart;"
    " “flown” weighs by distance, so that standing between two obstacles is no steering. Reversals are changes of the"
    " turn's sign from one turning step to the next, per step."
)
SENSITIVITY = (
    "Each choice that the paper leaves open, changed by itself, in runs as long as those as decided. Targets of several"
    " steps are no such choice (the paper's eq. (1) has one) and stand beside them. A conclusion flips if its "
    "interval lies wholly on the other side of zero than it does as decided."
)


def lead(findings: Sequence[Finding]) -> str:
    """One sentence: how many claims hold."""
    of = {claim.number: verdict([one for one in findings if one.claim == claim.number]) for claim in CLAIMS}
    parts = []
    for kind in (SUPPORTED, CONTRADICTED, UNDECIDED):
        numbers = [str(number) for number, found in of.items() if found == kind]
        listed = f" ({', '.join(numbers)})" if numbers else ""
        parts.append(f"{_are(len(numbers))} {kind}{listed}")
    return f"Of the paper's {len(CLAIMS)} claims, {', '.join(parts[:-1])} and {parts[-1]}."


def _are(count: int, of: str = "") -> str:
    return f"{count}{of} {'is' if count == 1 else 'are'}"


def sentence(claim: Claim, findings: Sequence[Finding]) -> str:
    """What the parts of a claim come to."""
    kinds = [(kind, sum(one.verdict == kind for one in findings)) for kind in (SUPPORTED, CONTRADICTED, UNDECIDED)]
    parts = [f"{_are(count, f' of {len(findings)} parts')} {kind}" for kind, count in kinds if count]
    said = [", ".join(parts) + "." if len(findings) > 1 else f"Its one part is {verdict(findings)}."]
    if against := [one for one in findings if one.against_itself]:
        said.append(
            f"The paper's own tables speak against it in {len(against)}: {'; '.join(one.text for one in against)}."
        )
    return " ".join([*said, claim.note]).strip()


def headline(findings: Sequence[Finding]) -> list[str]:
    """The part that decides, the first with the claim's own verdict: its question, then its numbers one by one."""
    decisive = next(one for one in findings if one.verdict == verdict(findings))
    if not decisive.n:
        return [decisive.text, "no runs"]
    own = [] if math.isnan(decisive.paper) else [f"the paper {tables.number(decisive.paper, decisive.digits)}"]
    ours = tables.with_interval(decisive.value, decisive.low, decisive.high, decisive.digits)
    p = p_shown(decisive)
    of_test = decisive.region.startswith("p")
    criterion = f"claimed {decisive.region}" if not of_test else f"p {p}" if p[0] in "<≤" else f"p = {p}"
    return [decisive.text, *own, f"ours {ours}", criterion, f"n = {decisive.n}"]
