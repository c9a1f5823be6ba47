"""What the study says in sentences: one and many, notes, and how p is shown."""

import numpy as np
import pytest

from uavnav.report import conclusions
from uavnav.report.claims import CLAIMS, audit
from uavnav.report.studies import of_paper


def of_claim(number):
    """Its parts without runs."""
    return [one for one in audit(lambda *_, **__: np.empty(0), of_paper) if one.claim == number]


def test_a_sentence_counts_parts_says_where_the_paper_speaks_against_itself_and_adds_the_claims_note():
    found = of_claim(2)
    mixed = [one._replace(verdict="contradicted") for one in found[:1]] + found[1:]
    assert conclusions.sentence(CLAIMS[1], mixed) == (
        "1 of 9 parts is contradicted, 8 of 9 parts are undecided. The paper's own tables speak against it in 2: "
        "full stops [%]: PPO with tanh the best; speed [px a step]: PPO with tanh the best. "
        "In its own table the steps are 1.58 and the distance 1.59 times the runner-up's."
    )
    assert conclusions.sentence(CLAIMS[2], of_claim(3)) == "6 of 6 parts are undecided."
    assert conclusions.sentence(CLAIMS[4], of_claim(5)) == "Its one part is undecided."


@pytest.mark.parametrize(
    ("p", "bound", "shown"),
    [(np.nan, False, "p = –"), (0.0123, False, "p = 0.012"), (0.0047, True, "p ≤ 0.005"), (0.0002, True, "p < 0.001")],
)
def test_the_headline_of_a_test_has_pairs_in_another_order_and_p(p, bound, shown):
    (crossover,) = of_claim(8)
    assert conclusions.headline([crossover])[1:] == ["no runs"]
    known = crossover._replace(value=1.0, n=8, p_holm=p, p_is_bound=bound)
    assert conclusions.headline([known])[1:] == ["the paper 4", "ours 1", shown, "n = 8"]
