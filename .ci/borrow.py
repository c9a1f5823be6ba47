"""Link into a folder what `pip install .` asks for, out of the environment of this process: nothing of an
extra.

The folder is another environment's site-packages; no package is downloaded or unpacked a second time.
"""

import sys
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement


def asked_for(name, extra=""):
    """Names, and an extra or none of each, of the distributions that one requires."""
    for line in distribution(name).requires or []:
        needed = Requirement(line)
        if needed.marker is None or needed.marker.evaluate({"extra": extra}):
            yield from ((needed.name, one) for one in ("", *needed.extras))


def closure(name):
    """Of a distribution, which itself is left out."""
    found, new = {}, [*asked_for(name)]
    while new:
        if (asked := new.pop()) not in found:
            found[asked] = distribution(asked[0])
            new += asked_for(*asked)
    return found.values()


def borrow(folder):
    for one in closure("uavnav"):
        for top in {file.parts[0] for file in one.files} - {"..", "__pycache__"}:  # ..: its commands
            if not (folder / top).exists():
                (folder / top).symlink_to(one.locate_file(top))


borrow(Path(sys.argv[1]))
