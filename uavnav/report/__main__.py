"""`python -m uavnav.report` is `uavnav report`."""

import sys

from uavnav.cli.report import main

if __name__ == "__main__":
    sys.exit(main())
