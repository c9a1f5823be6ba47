"""What the study says, in sentences made from its findings: no adjective without an interval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from uavnav.report import tables
from uavnav.report.claims import CLAIMS, Claim
from uavnav.report.frames import AS_DECIDED, total_frames
from uavnav.report.studies import Studies, paper_cells
from uavnav.report.verdicts import CONTRADICTED, KINDS, SEEDS, SUPPORTED, Finding, of_claim, p_in_words, verdict


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
    of = {claim.number: verdict(of_claim(findings, claim.number)) for claim in CLAIMS}
    parts = []
    for kind in KINDS:
        numbers = [str(number) for number, found in of.items() if found == kind]
        listed = f" ({', '.join(numbers)})" if numbers else ""
        parts.append(f"{_are(len(numbers))} {kind}{listed}")
    return f"Of the paper's {len(CLAIMS)} claims, {', '.join(parts[:-1])} and {parts[-1]}."


def _are(count: int, of: str = "") -> str:
    return f"{count}{of} {'is' if count == 1 else 'are'}"


def sentence(claim: Claim, findings: Sequence[Finding]) -> str:
    """What the parts of a claim come to."""
    kinds = [(kind, sum(one.verdict == kind for one in findings)) for kind in KINDS]
    parts = [f"{_are(count, f' of {len(findings)} parts')} {kind}" for kind, count in kinds if count]
    said = [", ".join(parts) + "." if len(findings) > 1 else f"Its one part is {verdict(findings)}."]
    if against := [one for one in findings if one.against_itself]:
        said.append(
            f"The paper's own tables speak against it in {len(against)}: {'; '.join(one.text for one in against)}."
        )
    return " ".join([*said, claim.note]).strip()


def turned(findings: Sequence[Finding], audits: Mapping[str, Sequence[Finding]]) -> str:
    """Which parts of a claim other readings decide the other way; often nothing."""
    found = [(finding.text, readings) for finding in findings if (readings := other_way(finding, audits))]
    said = "; ".join(f"{text} ({readings})" for text, readings in found)
    return f"Decided the other way, with intervals in tables/verdicts.csv: {said}." if said else ""


def other_way(finding: Finding, audits: Mapping[str, Sequence[Finding]]) -> str:
    """The readings that decide a part the other way, in words."""
    found = [
        reading
        for reading, findings in audits.items()
        for one in findings
        if one[:2] == finding[:2] and {one.verdict, finding.verdict} == {SUPPORTED, CONTRADICTED}
    ]
    every = len(found) > 1 and len(found) == len(audits) - 1
    return "by every other reading" if every else "by " + ", by ".join(found) if found else ""


def headline(findings: Sequence[Finding]) -> list[str]:
    """The part that decides, the first with the claim's own verdict: its question, then its numbers one by one."""
    decisive = next(one for one in findings if one.verdict == verdict(findings))
    if not decisive.n:
        return [decisive.text, "no runs"]
    own = [] if math.isnan(decisive.paper) else [f"the paper {tables.number(decisive.paper, decisive.digits)}"]
    ours = tables.with_interval(decisive.value, decisive.low, decisive.high, decisive.digits)
    criterion = p_in_words(decisive) if decisive.by_test else f"claimed {decisive.region}"
    return [decisive.text, *own, f"ours {ours}", criterion, f"n = {decisive.n}"]
