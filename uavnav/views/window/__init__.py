"""The live window of `uavnav play`."""
