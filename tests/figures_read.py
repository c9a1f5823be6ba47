"""What is on a figure, read back; and a table that two files of tests draw."""

import matplotlib
import pandas as pd


def texts(figure):
    """Every word on a figure, in legends too."""
    found = figure.findobj(matplotlib.text.Text)
    return [text.get_text() for text in found if text.get_text()]


def lines(axes, marker=None):
    return [line for line in axes.lines if marker is None or line.get_marker() == marker]


def switches(**values):
    """Differences of PPO and DQN under some switches, with intervals 4 wide, of 8 seeds."""
    rows = [(name, "PPO - DQN", value, value - 2, value + 2, 8) for name, value in values.items()]
    return pd.DataFrame(rows, columns=["switch", "conclusion", "value", "low", "high", "n"])
