"""The live window of `python -m uavnav.play`."""
