"""Forests of side studies, read back from what is drawn."""

import numpy as np
from figures_read import lines, switches

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
