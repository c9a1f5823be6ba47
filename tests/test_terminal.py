"""A command that is stopped while it is imported, or whose output nobody reads on, says a line at most."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import uavnav

ROOT = Path(uavnav.__file__).parent.parent
COMMANDS = {
    "_multiarray_umath": ["-m", "uavnav", "evaluate", "random"],
    "libtorch_cpu": [ROOT / "recipes" / "ppo.py", "total_frames=1e7", "compile=off", "out=run"],
}
"""And the library in the import of which each is stopped."""


def mapped(process, library):
    """Wait until a process has begun to load a library; its imports go on for a second or more."""
    began = time.monotonic()
    while time.monotonic() - began < 60 and process.poll() is None:
        if library in Path(f"/proc/{process.pid}/maps").read_text():
            return
        time.sleep(0.005)
    raise AssertionError(f"{library} was never loaded")


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="no /proc tells what a process has loaded")
@pytest.mark.parametrize("library", COMMANDS)
def test_ctrl_c_while_modules_are_imported_is_one_line_at_most(library, tmp_path):
    words = [sys.executable, *map(str, COMMANDS[library])]
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            mapped(process, library)
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=240)
        finally:
            process.kill()  # it would train for hours
    assert process.returncode != 0
    assert out == ""
    assert err in ("", "uavnav: stopped\n")
    assert not list(tmp_path.iterdir())


def test_a_training_run_that_nobody_reads_goes_on_and_is_finished(tmp_path):
    run = "-m uavnav train ppo total_frames=256 frames_per_batch=256 epochs=1 evaluate=false out=run"
    line = f"{sys.executable} {run} | true; exit ${{PIPESTATUS[0]}}"
    result = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert uavnav.Run(tmp_path / "run").meta["status"] == "finished"


UNREAD = f"""'
import runpy
runpy.run_path("{ROOT}/uavnav/cli/terminal.py")["end_quietly"]("mine")
import multiprocessing
lock = multiprocessing.get_context("spawn").Lock()
while True:
    print("a line", flush=True)
'"""
"""A command that is in the middle of its work, with a semaphore that another process of Python looks
after.
"""


@pytest.mark.parametrize(
    "command",
    [
        "-m uavnav",
        "-m uavnav runs",
        "-m uavnav evaluate reactive --episodes 2 --max-steps 50",
        f"-c {UNREAD}",
    ],
)
def test_a_command_that_nobody_reads_ends_with_141_as_by_sigpipe_and_leaves_no_word(command, tmp_path):
    line = f"{sys.executable} {command} | true; exit ${{PIPESTATUS[0]}}"
    result = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (141, "", "")


@pytest.mark.parametrize(
    ("command", "first"),
    [
        ("-m uavnav", f"uavnav {uavnav.__version__}: "),
        ("-m uavnav evaluate --help", "usage: uavnav evaluate "),
    ],
)
def test_a_reader_that_leaves_after_a_line_leaves_no_traceback(command, first, tmp_path):
    line = f"{sys.executable} {command} | head -1"
    result = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith(first)
    assert result.stdout.count("\n") == 1
