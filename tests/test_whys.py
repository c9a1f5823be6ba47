"""What asks why configurations differ: rows and contrasts on made-up seeds, and the configurations that
the study flies.
"""

from pathlib import Path

import numpy as np
import pytest

from uavnav import studies
from uavnav.report import tables, whys

ASKED = (
    "layer_norm",
    "init",
    "clip_epsilon",
    "epochs",
    "gamma",
    "epsilon_end",
    "entropy_coeff",
    "reward",
    "stack",
)


def evidence(clearance, seeds=10):
    """Ten seeds around 0, but clearance by study as given; nothing of other studies."""
    noise = np.linspace(-1, 1, seeds)

    def of(algorithm, activation, metric, study="main"):
        return clearance[study] + noise if metric == "clearance" and study in clearance else np.empty(0)

    return of


@pytest.mark.parametrize(
    ("narrow", "none", "shown"), [(90.0, 50.0, "40.0 [39.4, 40.6]"), (50.0, 50.0, "0.0 [−0.6, 0.6]")]
)
def test_a_contrast_of_10_seeds_each_has_its_welch_interval_and_questions_without_one_are_left_out(
    narrow, none, shown
):
    """s = 0.673 in both: 40 -+ 2.101 * 0.673 * sqrt(2 / 10) = 0.632."""
    table = whys.table(evidence({"clip_epsilon=0.05": narrow, "clip_epsilon=None": none}))
    contrast = "PPO with clip_epsilon=0.05 minus with clip_epsilon=None"
    assert [row[3:] for row in tables.listed(table, "whys") if row[1] == contrast] == [[shown, "10"]]
    assert whys.table(evidence({})).empty
    assert whys.table(evidence({"gamma=0.9": 1.0, "clip_epsilon=0.4": 50.0, "epochs=1": 60.0})).empty


def test_a_row_of_the_table_has_the_mean_of_its_seeds():
    rows = whys.table(evidence({"clip_epsilon=0.05": 90.0, "clip_epsilon=None": 50.0})).set_index("row")
    assert rows.loc["PPO clip_epsilon=0.05", ["value", "n"]].tolist() == [90.0, 10]


def test_the_study_why_flies_each_configuration_that_a_question_asks_for():
    flown = set()
    for configuration in studies.configurations(studies.read("why"), Path("out")):
        own = {
            name: getattr(configuration.config, name) for name in ASKED if hasattr(configuration.config, name)
        }
        default = {name: getattr(type(configuration.config)(), name) for name in own}
        flown |= {f"{name}={value}" for name, value in own.items() if value != default[name]}
    asked = {place[0] for one in whys.QUESTIONS for place in one.rows.values()} - {whys.SHORT, whys.LONG}
    assert flown == asked


@pytest.mark.parametrize("question", whys.QUESTIONS, ids=lambda one: one.name)
def test_each_question_draws_the_configurations_that_its_contrasts_hold_against_each_other(question):
    drawn = set(question.rows.values())
    for one in question.contrasts:
        assert {*one.first, *one.second} <= drawn
        assert one.metric in question.metrics
