"""`python -m uavnav.report` is `uavnav report`."""

import sys

from uavnav.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["report", *sys.argv[1:]]))
