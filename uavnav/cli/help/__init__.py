"""The help of each algorithm, which `python -m uavnav.cli.help` writes here, to be found without torch."""

from pathlib import Path

HERE = Path(__file__).parent


def text_of(algorithm: str) -> Path:
    """Where the help of an algorithm of the package is; a plugin's has none."""
    return HERE / f"{algorithm}.txt"
