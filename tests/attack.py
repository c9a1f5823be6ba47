"""Hostile input for every key, option, call and file, and a judge of how each is answered.

    python tests/attack.py --n 5000 --seed 0 [--class files]    a long attack: a table, and a line for each
    failed case python tests/attack.py --case files:0:17                    one of these cases again, with all
    that it says python tests/attack.py --list                               what would be tried

Keys come from the declarations and options from the parsers: new ones are attacked without a change here. The
inputs are in `attack_inputs` and `attack_files`. A case runs in a fork of this process, in a copy of a folder
of good files, within bounds of time and memory.
"""

import argparse
import atexit
import faulthandler
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import attack_files
import attack_inputs
import hypothesis
import torch
import warm
from bad_input import tree

from uavnav import files

LINE = 300
"""Characters of a line that refuses."""
MEMORY = 3.0
"""GiB that a case may hold at its peak."""
ROOM = 12 * 2**30
"""Bytes of addresses that a case may take beside those that it begins with."""
FILE = 2 * 2**30
"""Bytes of a file that a case may write."""
SECONDS = 20.0
"""Given to a case on an idle machine, and then to one that is stopped."""
LEFT_TO_WORK = 5.0
"""Seconds given to a case whose work may be as long as it asks, before it is stopped."""
LEFT_TO_TRAIN = 1.0
"""Seconds given to one that has begun to train."""
DRAWS = "layouts with goals are drawn for this world"
"""What a case says that then takes minutes."""
AT_ONCE = 2
BLOCK = 50
"""Cases that one call of Hypothesis draws: to repeat one, its block alone is drawn."""
VERDICTS = ("refused in one line", "accepted", "traceback", "hang", "memory", "long line", "half-written")
GOOD = VERDICTS[:2]
TRIED = re.compile(r"(^|/)(\.lock|journal\.jsonl|half/meta\.json|study/.*meta\.json)$")
"""Files that a command may change before it is refused: they say that it was tried."""
KINDS = {
    "settings": attack_inputs.settings(),
    "command-lines": attack_inputs.command_lines(),
    "library": attack_inputs.library(),
    "study-files": attack_files.study_files(),
    "files": attack_files.damaged(),
    "planted": attack_inputs.planted,
}
ATTACKED = tuple(KINDS)[:-1]
"""Those that are attacked unless others are named."""


class Ended(NamedTuple):
    """How a case ended."""

    status: int  # as `subprocess` has it; negative: by this signal
    said: str
    complained: str
    changed: list[str]  # paths
    killed: str = ""  # `hang` or `memory`: by whom watched it


# -- drawing -------------------------------------------------------------------------------------------------


class Enough(KeyboardInterrupt):
    """So many cases are drawn; Hypothesis lets it pass."""


def block(kind, seed, number, most=BLOCK):
    """The first cases of a block, the same in every process."""
    found = []

    @hypothesis.seed(f"{kind}:{seed}:{number}")
    @hypothesis.settings(
        max_examples=BLOCK,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(KINDS[kind])
    def note(case):
        found.append(case)
        if len(found) == most:
            raise Enough

    with suppress(Enough):
        note()
    return found


def cases(kind, seed, n):
    """So many cases of a class, each with its name."""
    number = 0
    while n > 0:
        for index, case in enumerate(block(kind, seed, number, min(n, BLOCK))):
            yield f"{kind}:{seed}:{number * BLOCK + index}", case
            n -= 1
        number += 1


def case_named(name):
    kind, seed, index = name.split(":")
    return block(kind, seed, int(index) // BLOCK)[int(index) % BLOCK]


# -- judging -------------------------------------------------------------------------------------------------


def judge(ended):
    """One of `VERDICTS`, and why, in a line."""
    lines = ended.complained.splitlines()
    if ended.killed:
        return ended.killed, lines[-1] if lines else "without a word"
    if "Traceback" in ended.complained or ended.status not in (0, 1, 2, 130):
        named = [
            line
            for line in lines
            if line[:1].isalpha() and not line.startswith(("Traceback", "Extension mod"))
        ]
        fatal = [line for line in lines if line.startswith("Fatal Python error")]
        return "traceback", f"status {ended.status}: {(fatal or named or lines or [''])[-1][:LINE]}"
    if ended.status == 2:
        refusals = [line for line in ended.complained.split("\n")[:-1] if ": left out: " not in line]
        wrong = [line for line in ended.complained.split("\n") if len(line) > LINE or not line.isprintable()]
        if wrong:
            return "long line", f"{len(wrong[0])} characters: {wrong[0][:LINE]!r}"
        if len(refusals) != 1:
            return "long line", f"{len(refusals)} lines: {refusals[:3]}"
    changed = [path for path in ended.changed if not TRIED.search(path)]
    left = [path for path in changed if path.endswith(".aside")]
    if left or (ended.status == 2 and changed):
        return "half-written", f"{', '.join((left or changed)[:5])} after {lines[-1:]}"
    return GOOD[ended.status != 2], lines[-1] if lines else ""


# -- running -------------------------------------------------------------------------------------------------


def warmed():
    """Import what commands import, once; no threads may be started before a fork."""
    os.environ |= {"BROWSER": "true %s", "MPLBACKEND": "agg"}
    torch.set_num_threads(1)
    attack_files.warmed()
    signal.signal(signal.SIGINT, signal.default_int_handler)


def forked(function, *arguments):
    """Call a function in a fork, and return its number."""
    number = os.fork()
    if number == 0:
        try:
            function(*arguments)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(99)
    return number


def make_good(folder):
    """The good files, made in a fork, since tables start threads."""
    _, status = os.waitpid(forked(_make_good, folder), 0)
    assert status == 0, "the good files could not be made"
    return folder


def _make_good(folder):
    folder.mkdir()
    os.chdir(folder)
    attack_files.make_good(folder)


@contextmanager
def scratch_folder():
    """As tempfile's own, which a fork would remove at its end."""
    folder = Path(tempfile.mkdtemp(prefix="attack-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class Attempt:
    """A case that is under way, in a fork."""

    def __init__(self, name, case, good, scratch, seconds, memory):
        self.name, self.case, self.scratch, self.seconds = (
            name,
            case,
            scratch / name.replace(":", "-"),
            seconds,
        )
        self.memory = memory * 2**30
        self.here = self.scratch / "one" / "here"  # `..` leads nowhere else
        self.here.parent.mkdir(parents=True)
        shutil.copytree(good, self.here, symlinks=True)
        self.began, self.asked, self.killed, self.peak = time.monotonic(), None, "", 0
        self.pid = forked(self._be)

    def _be(self):
        """Be the process of the case, to its end."""
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.chdir(self.here)
        for number, path in enumerate((os.devnull, self.scratch / "out", self.scratch / "err")):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
        os.closerange(3, 256)
        sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115
        sys.stderr = open(2, "w", errors="backslashreplace", buffering=1)  # noqa: SIM115
        faulthandler.enable()
        with open("/proc/self/statm") as sizes:
            taken = int(sizes.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, taken + ROOM))
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE, FILE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        files.MEMORY_BYTES = int(self.memory / 2)  # so much a machine of this size would leave for a run
        self.case.spoil(self.here)
        before = tree(self.here)
        (self.scratch / "ready").touch()
        try:
            status = self.case.act()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else bool(end.code)
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except BaseException as error:
            sys.excepthook(*sys.exc_info())
            status = 130 if isinstance(error, KeyboardInterrupt) else 1
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading._shutdown()
        atexit._run_exitfuncs()
        sys.stdout.flush()
        changed = {path for path, _ in before.items() ^ tree(self.here).items()}
        (self.scratch / "changed").write_bytes("\n".join(changed).encode(errors="backslashreplace"))
        os._exit(status or 0)

    def ended(self):
        """How it ended; None while it goes on, which is not for ever."""
        number, status, used = os.wait4(self.pid, os.WNOHANG)
        if number == 0:
            self._watch()
            return None
        self.kill_all()
        self.peak = max(self.peak, used.ru_maxrss * 1024)
        said, complained, changed = (self._text(name) for name in ("out", "err", "changed"))
        killed = self.killed or ("memory" if self.peak > self.memory else "")
        if not (self.scratch / "ready").exists():
            complained += "\nTraceback of the attack itself: its input could not be made"
        shutil.rmtree(self.scratch, ignore_errors=True)
        return Ended(
            os.waitstatus_to_exitcode(status), said, complained, changed.split("\n") * bool(changed), killed
        )

    def _watch(self):
        now = time.monotonic()
        with suppress(OSError, IndexError), open(f"/proc/{self.pid}/statm") as sizes:
            self.peak = max(self.peak, int(sizes.read().split()[1]) * resource.getpagesize())
        busy = max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))  # others work here too
        seconds, patience = self.seconds * busy, LEFT_TO_WORK * busy if self.case.works else LEFT_TO_TRAIN
        works = self.case.works or any(self.here.glob("**/progress.json")) or DRAWS in self._text("err")
        if self.peak > self.memory:
            self._kill("memory")
        elif self.asked is not None:
            if now - self.asked > seconds:
                self._kill("hang")
        elif now - self.began > seconds and not works:
            self._kill("hang")
        elif works and now - self.began > patience:
            self.asked = now
            os.kill(self.pid, signal.SIGINT)

    def _kill(self, why):
        self.killed = why
        os.kill(self.pid, signal.SIGKILL)

    def kill_all(self):
        """End what the case started and left too: whatever works in its folder."""
        for link in Path("/proc").glob("[0-9]*/cwd"):
            with suppress(OSError):
                if os.readlink(link).startswith(f"{self.scratch}/"):
                    os.kill(int(link.parts[2]), signal.SIGKILL)

    def _text(self, name):
        path = self.scratch / name
        return path.read_text(errors="backslashreplace")[: 2**20] if path.exists() else ""


def run(named, good, seconds=SECONDS, memory=MEMORY):
    """Run cases, a few at a time; yields the name of each, the case, and how it ended."""
    with scratch_folder() as scratch:
        waiting, under_way, more = iter(named), [], True
        try:
            while more or under_way:
                while more and len(under_way) < AT_ONCE:
                    name, case = next(waiting, (None, None))
                    more = name is not None
                    if more:
                        under_way.append(Attempt(name, case, good, scratch, seconds, memory))
                time.sleep(0.01)
                for one in list(under_way):
                    if (ended := one.ended()) is not None:
                        under_way.remove(one)
                        yield one.name, one.case, ended
        finally:
            for one in under_way:
                one.kill_all()


# -- the command ---------------------------------------------------------------------------------------------


def table(counts):
    """Verdicts by class, as a table."""
    lines = ["| class | tried | " + " | ".join(VERDICTS) + " |", "|---" * (len(VERDICTS) + 2) + "|"]
    for kind, count in counts.items():
        configurations = [kind, count.total(), *(count[verdict] for verdict in VERDICTS)]
        lines.append("| " + " | ".join(map(str, configurations)) + " |")
    return "\n".join(lines)


def attack(kinds, each, seed, good, seconds, memory):
    """Run so many cases of each class; returns how many of each verdict, and a line for each that failed."""
    counts, failed = {kind: Counter() for kind in kinds}, []
    for kind in kinds:
        for name, case, ended in run(cases(kind, seed, each), good, seconds, memory):
            verdict, why = judge(ended)
            counts[kind][verdict] += 1
            if verdict not in GOOD:
                failed.append(f"{name}  {verdict}  {case.told[:400]}  ->  {why}".replace("\n", "\\n"))
                print(failed[-1].encode(errors="backslashreplace").decode(), flush=True)
    return counts, failed


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--n", type=int, default=500, help="cases, of all classes together (default: 500)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--class", dest="kinds", nargs="+", choices=KINDS, default=ATTACKED)
    parser.add_argument("--case", metavar="CLASS:SEED:INDEX", help="one case again, with all that it says")
    parser.add_argument("--list", action="store_true", help="say what would be tried, and try nothing")
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help=f"given to a case (default: {SECONDS:.0f})"
    )
    parser.add_argument(
        "--memory", type=float, default=MEMORY, help=f"GiB for a case (default: {MEMORY:.0f})"
    )
    given = parser.parse_args()
    each = -(-given.n // len(given.kinds))
    if given.list:
        for name, case in (one for kind in given.kinds for one in cases(kind, given.seed, each)):
            print(name, ascii(case.told))
        return 0
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # and clean up
    warm.address()
    warmed()
    with scratch_folder() as folder:
        good = make_good(folder / "good")
        if given.case:
            case = case_named(given.case)
            print(f"{case.told[:2000]!r}")
            [(_, _, ended)] = run([(given.case, case)], good, given.seconds, given.memory)
            print(
                ended.said, ended.complained, f"changed: {ended.changed}", ": ".join(judge(ended)), sep="\n"
            )
            return judge(ended)[0] not in GOOD
        counts, failed = attack(given.kinds, each, given.seed, good, given.seconds, given.memory)
    print(table(counts))
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
