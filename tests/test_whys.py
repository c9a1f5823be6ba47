"""What asks why cells differ: rows, contrasts and sentences on made-up seeds, and the cells that the study flies."""

from pathlib import Path

import numpy as np
import pytest
from tied import too_long

from uavnav import studies, style
from uavnav.report import figures, findings, whys
from uavnav.report.studies import WHY, WHY_LONG

ASKED = ("layer_norm", "init", "clip_epsilon", "epochs", "gamma", "epsilon_end", "entropy_coeff", "reward", "stack")


def evidence(clearance, seeds=10):
    """Ten seeds around 0, but clearance by study as given; nothing of other studies."""
    noise = np.linspace(-1, 1, seeds)

    def of(algorithm, activation, metric, study="main"):
        return clearance[study] + noise if metric == "clearance" and study in clearance else np.empty(0)

    return of


def said(table, name):
    question = next(one for one in whys.QUESTIONS if one.name == name)
    return [str(one) for one in findings.why({"whys": table}, question)]


@pytest.mark.parametrize(("narrow", "none", "how"), [(90.0, 50.0, "more"), (50.0, 90.0, "less")])
def test_a_contrast_of_40_px_with_10_seeds_each_is_said_with_its_welch_interval(narrow, none, how):
    """s = 0.673 in both: 40 -+ 2.101 * 0.673 * sqrt(2 / 10) = 0.632."""
    table = whys.table(evidence({"clip_epsilon=0.05": narrow, "clip_epsilon=None": none}))
    assert said(table, "caution") == [
        f"PPO keeps 40.0 (39.4 to 40.6) px {how} clearance with the narrowest clip range than with none."
    ]


def test_a_row_of_a_figure_has_the_mean_of_its_seeds():
    rows = whys.table(evidence({"clip_epsilon=0.05": 90.0, "clip_epsilon=None": 50.0})).set_index("row")
    assert rows.loc["PPO clip_epsilon=0.05", ["value", "n"]].tolist() == [90.0, 10]


def test_equal_cells_are_not_told_apart_and_cells_without_seeds_are_left_out():
    assert said(whys.table(evidence({"epochs=1": 50.0, "epochs=20": 50.0})), "caution") == [
        "PPO's clearance with one epoch a batch and with twenty is not told apart: 0.0 (−0.6 to 0.6) px."
    ]
    nothing = whys.table(evidence({}))
    assert said(nothing, "caution") == []
    assert figures._whys({"whys": nothing}, style.WIDTH) == []


def test_a_figure_has_a_row_for_each_cell_that_was_flown_and_is_there_once_a_contrast_is():
    flown = {"gamma=0.9": 1.0, "clip_epsilon=0.4": 50.0, "epochs=1": 60.0}
    assert figures._whys({"whys": whys.table(evidence(flown))}, style.WIDTH) == []
    (found,) = figures._whys({"whys": whys.table(evidence(flown | {"epochs=20": 55.0}))}, style.WIDTH)
    assert found.name == "whys-caution"
    assert found.caption.startswith("Do gradual updates make PPO cautious? PPO keeps 5.0 (4.4 to 5.6) px more")
    assert "PPO clip_epsilon=0.4, clearance [px] 50" in found.drawn.alt


def test_the_study_why_flies_each_cell_that_a_question_asks_for():
    flown = set()
    for cell in studies.cells(studies.read("why"), Path("out")):
        own = {name: getattr(cell.config, name) for name in ASKED if hasattr(cell.config, name)}
        default = {name: getattr(type(cell.config)(), name) for name in own}
        flown |= {f"{name}={value}" for name, value in own.items() if value != default[name]}
    asked = {place[0] for one in whys.QUESTIONS for place in one.rows.values()} - {whys.SHORT, whys.LONG}
    assert flown == asked
    assert {study.partition("=")[0] for study in asked} - WHY_LONG - {"init"} <= WHY


@pytest.mark.parametrize("question", whys.QUESTIONS, ids=lambda one: one.name)
def test_each_question_draws_the_cells_that_its_contrasts_hold_against_each_other(question):
    drawn = set(question.rows.values())
    for one in question.contrasts:
        assert {*one.first, *one.second} <= drawn
        assert one.metric in question.metrics


@pytest.mark.parametrize("name", [one.name for one in whys.QUESTIONS])
def test_each_question_has_a_sentence_of_at_most_25_words_for_each_way_its_answer_may_go(name):
    question = next(one for one in whys.QUESTIONS if one.name == name)
    told = [words for one in question.contrasts if one.said for words in one.said]
    assert len(told) >= 6
    for words in told:
        assert words.count("{}") == 1
        assert too_long(words.replace("{}", "12.3 (-11.1 to 13.4)")) == []
