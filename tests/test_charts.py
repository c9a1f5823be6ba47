"""Forests of side studies, the seeds that a difference would need, and wall times, read back from what is drawn."""

import numpy as np
import pandas as pd
from figures_read import lines, switches, texts

from uavnav import style
from uavnav.report import charts


def test_a_forest_shades_the_defaults_interval_and_greys_intervals_with_0():
    drawn = charts.sensitivity(switches(slots=1.0, default=5.0, padding=-3.0))
    (axes,) = drawn.figure.axes
    (shade,) = axes.patches
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == (3.0, 7.0)
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        *("default, n = 8", "slots, n = 8", "padding, n = 8")
    ]
    colours = {float(line.get_xdata()[0]): line.get_color() for line in lines(axes, "o")}
    assert colours[5.0] == colours[-3.0] != colours[1.0] == style.PALE
    assert "PPO - DQN 5.00 (95 % interval 3.00 to 7.00; n = 8) by default" in drawn.alt
    assert drawn.alt.endswith("of the same sign under 1 of 2 other choices.")


def test_a_forest_without_a_default_or_an_interval_has_no_shade():
    drawn = charts.sensitivity(switches(slots=1.0).assign(low=np.nan, high=np.nan))
    assert len(drawn.figure.axes[0].patches) == 0
    assert "1 choices, none of them the default" in drawn.alt


def test_power_sorts_pairs_and_says_what_is_endless_and_not_known():
    table = pd.DataFrame({"pair": ["a", "b", "c", "d"], "seeds": [30.0, np.nan, 4.0, np.inf]})
    drawn = charts.power(table, n=20)
    (axes,) = drawn.figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["c", "a", "d", "b"]
    dots = [(float(x), float(y)) for line in lines(axes, "o") for x, y in line.get_xydata()]
    assert sorted(dots) == [(4.0, 0.0), (30.0, 1.0)]
    assert {"no difference seen: no number would do", "not known", "seeds that there are: 20"} <= set(
        texts(drawn.figure)
    )
    assert drawn.alt.endswith(
        "from c 4 to a 30, median 17; no difference seen in 1; not known of 1; "
        "of 4 pairs 1 need no more than the 20 that there are."
    )
    assert axes.get_xscale() == "log"


def test_more_than_10000_seeds_are_an_arrow_at_10000_and_ticks_are_powers_of_ten():
    drawn = charts.power(pd.DataFrame({"pair": ["a", "b"], "seeds": [2e8, 12.0]}), n=20, most=10_000)
    (axes,) = drawn.figure.axes
    assert [line.get_xdata().tolist() for line in lines(axes, ">") if len(line.get_xdata())] == [[10_000]]
    assert {"> 10,000", "12"} <= set(texts(drawn.figure))
    assert axes.get_xlim() == (1, 40_000)
    ticks = [place for place in axes.get_xticks() if 1 <= place <= 40_000]
    assert ticks == [1, 10, 100, 1_000, 10_000]
    assert "from b 12 to a more than 10,000, median more than 10,000;" in drawn.alt


def test_power_of_nothing_finite_is_drawn():
    drawn = charts.power(pd.DataFrame({"pair": ["a", "b"], "seeds": [np.nan, np.inf]}), n=20)
    assert "no difference seen in 1; not known of 1; of 2 pairs 0 need" in drawn.alt
    style.save(drawn.figure)


def test_6_minutes_are_100_times_faster_than_the_papers_ten_hours():
    table = pd.DataFrame({"cell": ["PPO tanh", "PPO tanh", "DQN relu"], "seconds": [180.0, 540.0, 72_000.0]})
    table = table.assign(seeds=[20, 20, 5])
    drawn = charts.speed(table)
    (axes,) = drawn.figure.axes
    assert {"6 min: 100 × faster", "20 h: 2 × slower", "the paper: about 10 hours"} <= set(texts(drawn.figure))
    assert [10.0, 10.0] in [list(line.get_xdata()) for line in axes.lines]
    assert axes.get_xscale() == "log"
    assert drawn.alt == (
        "Wall time of a million frames of one seed: its share of a run of 5 to 20 side by side: "
        "PPO tanh 6 min, DQN relu 20 h; the paper took about 10 hours."
    )


def test_18_seconds_are_2000_times_faster_in_plain_numbers():
    drawn = charts.speed(pd.DataFrame({"cell": ["PPO tanh"], "seconds": [18.0], "seeds": [20]}))
    assert "18 s: 2,000 × faster" in texts(drawn.figure)
