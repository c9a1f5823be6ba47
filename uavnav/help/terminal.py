"""How a command ends that is stopped, or whose output nobody reads on: in one line at most, without a traceback."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from types import FrameType, TracebackType


def end_quietly(name: str) -> None:
    """From now on Ctrl-C says `name: stopped`, and a closed pipe says nothing; name: of the command."""

    interrupted = threading.Event()

    def hear(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        signal.default_int_handler(number, frame)

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        hidden = interrupted.is_set() and issubclass(kind, ImportError)  # NumPy makes one of it where it is imported
        if hidden or issubclass(kind, KeyboardInterrupt):
            print(f"{name}: stopped", file=sys.stderr)
        elif not issubclass(kind, BrokenPipeError):
            sys.__excepthook__(kind, error, trace)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, hear)
    sys.excepthook = hook
    atexit.register(_flush)


def _flush() -> None:
    """Write what is left; Python would tell of a reader that is gone."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
