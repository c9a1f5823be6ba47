"""What the study says, in sentences made from its findings: no adjective without an interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

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
from uavnav.report.frames import AS_DECIDED, total_frames
from uavnav.report.studies import Studies, paper_cells

RULE = (
    "A part of a claim is supported or contradicted only if the 95 % bootstrap interval over training seeds, "
    "adjusted by Holm for all parts of all claims, lies wholly inside or outside the claimed region, with at least "
    f"{SEEDS} seeds in every cell; else it is undecided. A claim is contradicted if one of its parts is, supported if"
    f" all are. The primary reading is {PRIMARY}; the others stand beside it; an episode's stops, turns and speed are"
    " ratios to its own steps, and a seed's their mean over episodes, but in the reading of ratios of means. Claim 8"
    " asks a test instead (p < 0.05 by Holm), which can support and never contradict."
)
FIXED = (
    "The rule's code is of commit 8c7dc96, written after a pilot of three seeds a cell had been read, when the first"
    " of the study's eight cells had ended and the second was in its last minute; paired resampling for claim 4's "
    "times, the levels after the first failure of Holm, and claim 9's share of the distance flown were added while "
    "runs were under way and before their results were read. After results had been read, on 2026-11-21, claim 8's "
    f"test, which rejected equal orders at unequal noise, gave way to one of crossovers ({PRIMARY}: undecided under "
    "both, Holm's p 0.41 and 1; last 100: supported under the old one, undecided under the new), claim 9's drones "
    "came to fly the empty arena as each reading says, which they had done sampled in all (commit 178ace5; greedy: "
    "undecided before, contradicted since), and claim 11 came to count seeds instead of runs."
)
BEHAVIOUR = (
    f"Flights of at most {WATCHED_STEPS} steps on {WATCHED_LAYOUTS} test sets, acting as in training. A drone is in a"
    " corridor where two bodies (circles or walls) are within 120 px of its centre in directions at least 120° "
    "apart; “flown” weighs by distance, so that standing between two obstacles is no steering. Reversals are changes"
    " of the turn's sign from one turning step to the next, per step."
)
NOT_OF_TRAINING = (
    "Claim 9 and the reversals of claim 10 are of flights on test sets, sampled but in the greedy reading, and claim"
    " 11 is of run times: their verdicts by training episodes are the same evidence again, and no further agreement."
)


def sensitivity(studies: Studies, found: pd.DataFrame) -> str:
    """What the table of switches shows, and what it comes to. found: as `frames.sensitivity` gives it."""
    flipped = found[found["flips"] == "yes"]
    decided = found[found["switch"] == AS_DECIDED].set_index("conclusion")
    beyond = [
        f"{one['conclusion']} with {one['switch']} ({tables.with_interval(one['value'], one['low'], one['high'], 1)})"
        for one in found[found["flips"] == "sign"].to_dict("records")
        if one["low"] * one["high"] > 0 and decided["low"][one["conclusion"]] * decided["high"][one["conclusion"]] <= 0
    ]
    said = [
        "Each choice that the paper leaves open, changed by itself: reward per episode over all training episodes, the"
        f" difference of the means that a column names, with its 95 % interval over seeds, after"
        f" {total_frames(studies.baseline)} frames a seed in every row; after more they may differ. Targets of several"
        " steps are no such choice (the paper's eq. (1) has one) and stand beside them.",
        "A conclusion flips if its interval lies wholly on the other side of zero than it does as decided; “other sign”"
        " says that the estimate alone changes sides.",
        f"Flipped: {'; '.join(f'{one.conclusion} by {one.switch}' for one in flipped.itertuples())}."
        if len(flipped)
        else "None flips.",
    ]
    if beyond:
        said.append(f"Where zero is within the interval as decided, it is not with a switch: {'; '.join(beyond)}.")
    return " ".join(said)


def by_default(studies: Studies, found: pd.DataFrame) -> str:
    """What the table of tuned cells shows. found: as `frames.by_default` gives it."""
    few = f" A claim's verdict asks for at least {SEEDS} seeds." if (found["n"] < SEEDS).any() else ""
    return (
        "Is PPO above DQN more than a matter of defaults? Reward per episode, sampled evaluation, PPO minus DQN, mean "
        "over the activations that both have with the preset, and 95 % interval, after "
        f"{total_frames(studies.tuned)} frames a seed with the preset and {total_frames(paper_cells(studies.main))} in "
        f"the main study.{few}"
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


def elsewhere(finding: Finding, audits: Mapping[str, Sequence[Finding]]) -> dict[str, Finding]:
    """The same part in the readings that decide it the other way."""
    same = {reading: [one for one in found if _part(one) == _part(finding)] for reading, found in audits.items()}
    return {
        reading: one
        for reading, found in same.items()
        for one in found
        if {one.verdict, finding.verdict} == {SUPPORTED, CONTRADICTED}
    }


def _part(finding: Finding) -> tuple[int, str]:
    return finding.claim, finding.text


def turned(findings: Sequence[Finding], audits: Mapping[str, Sequence[Finding]]) -> str:
    """Which parts of a claim other readings decide the other way; often nothing."""
    found = [(finding.text, readings) for finding in findings if (readings := other_way(finding, audits))]
    said = "; ".join(f"{text} ({readings})" for text, readings in found)
    return f"Decided the other way, with intervals in tables/verdicts.csv: {said}." if said else ""


def other_way(finding: Finding, audits: Mapping[str, Sequence[Finding]]) -> str:
    """The readings that decide a part the other way, in words."""
    found = elsewhere(finding, audits)
    every = len(found) > 1 and len(found) == len(audits) - 1
    return "by every other reading" if every else "by " + ", by ".join(found) if found else ""


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
