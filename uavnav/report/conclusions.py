"""What the study says, in sentences made from its findings: no adjective without an interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from uavnav.report import tables
from uavnav.report.claims import PRIMARY, Claim
from uavnav.report.frames import AS_DECIDED, total_frames
from uavnav.report.studies import Studies, paper_cells
from uavnav.report.verdicts import (
    ABSENT,
    AGAINST_ITSELF,
    BESIDE,
    COUNTS,
    REPLICATES,
    REVERSES,
    SEEDS,
    TOO_SMALL,
    VERDICTS,
    Finding,
)
from uavnav.runs.readings import decimals, words


def sensitivity(studies: Studies, found: pd.DataFrame) -> str:
    """What the table of switches shows, and what it comes to. found: as `frames.sensitivity` gives it."""
    flipped, digits = found[found["flips"] == "yes"], decimals("reward", PRIMARY)
    decided = found[found["switch"] == AS_DECIDED].set_index("conclusion")
    beyond = [
        f"{one['conclusion']} with {one['switch']}"
        f" ({tables.with_interval(one['value'], one['low'], one['high'], digits)})"
        for one in found[found["flips"] == "sign"].to_dict("records")
        if one["low"] * one["high"] > 0 and decided["low"][one["conclusion"]] * decided["high"][one["conclusion"]] <= 0
    ]
    said = [
        f"Each choice that the paper leaves open, changed by itself: {words('reward', PRIMARY)} of training, the"
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


def sentence(claim: Claim, findings: Sequence[Finding]) -> str:
    """What the parts of a claim come to."""
    counting = [one.verdict for one in findings if one.standing == COUNTS]
    kinds = [f"{counting.count(kind)} {kind}" for kind in VERDICTS if kind in counting]
    parts = "1 part that counts" if len(counting) == 1 else f"{len(counting)} parts that count"
    said = [f"Of {parts}: {', '.join(kinds)}."] if counting else ["No part counts."]
    for standing, why in ((AGAINST_ITSELF, "The paper contradicts itself in"), (TOO_SMALL, "Too small to see:")):
        if texts := [one.text for one in findings if one.standing == standing]:
            said.append(f"{why} {'; '.join(texts)}.")
    if all(one.standing == BESIDE for one in findings):
        said = []
    return " ".join([*said, claim.note]).strip()


def turned(findings: Sequence[Finding], audits: Mapping[str, Sequence[Finding]]) -> str:
    """Which parts of a claim other readings decide the other way; often nothing."""
    found = [(finding.text, readings) for finding in findings if (readings := other_way(finding, audits))]
    said = "; ".join(f"{text} ({readings})" for text, readings in found)
    return f"Decided the other way, with intervals in tables/verdicts.csv: {said}." if said else ""


def other_way(finding: Finding, audits: Mapping[str, Sequence[Finding]]) -> str:
    """The readings that decide a part the other way, in words."""
    against = {REVERSES, ABSENT}
    found = [
        reading
        for reading, findings in audits.items()
        for one in findings
        if one[:2] == finding[:2] and REPLICATES in (pair := {one.verdict, finding.verdict}) and pair & against
    ]
    every = len(found) > 1 and len(found) == len(audits) - 1
    return "by every other reading" if every else "by " + ", by ".join(found) if found else ""
