"""A command that is stopped, or whose output nobody reads on, ends in one line without a traceback."""

from __future__ import annotations

import atexit
import os
import signal
import sys
from types import FrameType, TracebackType

UNREAD = 128 + 13  # the status of a command whose reader is gone, as of any program that SIGPIPE ends


def end_quietly(name: str) -> None:
    """From now on Ctrl-C says `name: stopped`, and a closed pipe says nothing; name: of the command."""
    unread: list[BaseException] = []

    def hear(number: int, frame: FrameType | None) -> None:
        if _importing(frame):  # NumPy makes an ImportError of an interrupt there
            os.write(sys.stderr.fileno(), f"{name}: stopped\n".encode())
            os._exit(128 + number)
        signal.default_int_handler(number, frame)

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print(f"{name}: stopped", file=sys.stderr)
        elif issubclass(kind, BrokenPipeError):
            unread.append(error)
        else:
            sys.__excepthook__(kind, error, trace)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, hear)
    sys.excepthook = hook
    atexit.register(_flush, unread)


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported, somewhere up the stack."""
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


def _flush(unread: list[BaseException]) -> None:
    """Write what is left, the last thing of all; Python would tell of a reader that is gone."""
    try:
        sys.stdout.flush()
    except BrokenPipeError as error:
        unread.append(error)
    if unread:
        os._exit(UNREAD)
