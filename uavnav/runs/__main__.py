"""`python -m uavnav.runs` is `uavnav runs`."""

import sys
from importlib import import_module

if __name__ == "__main__":
    sys.exit(import_module("uavnav.commands.runs").main())
