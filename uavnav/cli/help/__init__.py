"""The help of each algorithm, as `uavnav train ALGORITHM --help` shows it.

`python -m uavnav.cli.help` writes it into this folder for each algorithm of the package, where it is found
without torch.
"""

from pathlib import Path

HERE = Path(__file__).parent


def text_of(algorithm: str) -> Path:
    """Where the help of an algorithm of the package is; a plugin's has none."""
    return HERE / f"{algorithm}.txt"
