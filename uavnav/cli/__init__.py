"""The command line: a module for each command, and `commands`, which knows their arguments without torch."""
