"""What the study says in sentences of its switches and its tuned cells."""

import pandas as pd

from uavnav.report import conclusions
from uavnav.report.studies import Studies


def switches(*rows):
    return pd.DataFrame(rows, columns=["switch", "conclusion", "value", "low", "high", "n", "flips"])


def test_the_sentences_of_the_switches_name_what_flips_and_what_leaves_zero_out():
    none = Studies({}, {}, {}, {}, {}, {}, {}, [])
    decided = [("default", "A above B", 4.0, 3.0, 5.0, 10, ""), ("default", "C above D", 0.3, -1.8, 2.2, 10, "")]
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "C above D", -1.8, -3.0, -0.6, 5, "sign")))
    assert (
        "None flips. Where zero is within the interval as decided, it is not with a switch: C above D with k=4 " in said
    )
    assert "(−1.8000 [−3.0000, −0.6000])." in said
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "A above B", -2.0, -3.0, -1.0, 5, "yes")))
    assert said.endswith("Flipped: A above B by k=4.")
    said = conclusions.sensitivity(none, switches(*decided, ("k=4", "C above D", -0.2, -3.0, 2.6, 5, "sign")))
    assert said.endswith("None flips.")


def test_the_caption_of_the_tuned_cells_says_where_seeds_are_fewer_than_a_verdict_asks_for():
    none = Studies({}, {}, {}, {}, {}, {}, {}, [])
    few = "A claim's verdict asks for at least 5 seeds."
    assert conclusions.by_default(none, pd.DataFrame({"n": [4, 20]})).endswith(few)
    assert few not in conclusions.by_default(none, pd.DataFrame({"n": [5, 20]}))
