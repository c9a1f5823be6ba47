"""What the study says in sentences: one and many, notes, and how p is shown."""

import numpy as np
import pandas as pd
import pytest

from uavnav.report import conclusions
from uavnav.report.claims import CLAIMS
from uavnav.report.studies import Studies, of_paper
from uavnav.report.verdicts import audit


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


def test_a_part_that_other_readings_decide_the_other_way_is_named_with_them():
    turning = of_claim(1)[2]._replace(verdict="contradicted")
    supported = turning._replace(value=12.0, low=11.0, high=13.0, verdict="supported")
    audits = {"here": [turning], "last": [supported], "greedy": [turning._replace(verdict="undecided")]}
    assert conclusions.other_way(turning, audits) == "by last"
    assert conclusions.turned([turning], audits) == (
        "Decided the other way, with intervals in tables/verdicts.csv: turning [%]: PPO better than DQN, means of four"
        " activations (by last)."
    )
    everywhere = {reading: [supported] for reading in ("last", "greedy")} | {"here": [turning]}
    assert conclusions.other_way(turning, everywhere) == "by every other reading"
    assert conclusions.turned([turning], {"here": [turning]}) == ""
    assert conclusions.turned(of_claim(1), audits | {"here": of_claim(1)}) == ""  # undecided is not turned


def switches(*rows):
    return pd.DataFrame(rows, columns=["switch", "conclusion", "value", "low", "high", "n", "flips"])


def test_the_sentences_of_the_switches_name_what_flips_and_what_leaves_zero_out():
    none = Studies({}, {}, {}, {}, {}, [])
    decided = [("default", "A above B", 4.0, 3.0, 5.0, 10, ""), ("default", "C above D", 0.3, -1.8, 2.2, 10, "")]
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "C above D", -1.8, -3.0, -0.6, 5, "sign")))
    assert (
        "None flips. Where zero is within the interval as decided, it is not with a switch: C above D with k=4 " in said
    )
    assert "(−1.8 [−3.0, −0.6])." in said
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "A above B", -2.0, -3.0, -1.0, 5, "yes")))
    assert said.endswith("Flipped: A above B by k=4.")
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "C above D", -0.2, -3.0, 2.6, 5, "sign")))
    assert said.endswith("None flips.")


def test_the_caption_of_the_tuned_cells_says_where_seeds_are_fewer_than_a_verdict_asks_for():
    none = Studies({}, {}, {}, {}, {}, [])
    few = "A claim's verdict asks for at least 8 seeds."
    assert conclusions.by_default(none, pd.DataFrame({"n": [5, 20]})).endswith(few)
    assert few not in conclusions.by_default(none, pd.DataFrame({"n": [8, 20]}))
