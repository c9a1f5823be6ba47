"""`uavnav train`: from a command line to runs, and the process that trains a share of one."""
