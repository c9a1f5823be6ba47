"""New Python processes that need not import PyTorch: forks of a server that has imported it and the package
before.

What a process imports takes four seconds of a core, what a test asks of it often a tenth. With the fixture
`warm`, or `warm_module`, `Popen` takes the place of `subprocess.Popen`, also in the processes that are
started so. How a process begins from nothing is tested without them, by test_terminal, test_recipes and
test_first_run.
"""

import atexit
import ctypes
import importlib
import json
import os
import runpy
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import types
from contextlib import suppress

ADDRESS = "UAVNAV_WARM"
"""The variable with the server's name, an abstract socket of Linux."""
FIRST = "UAVNAV_WARM_FIRST"
"""The variable with a line of Python that a new process runs first."""
PATH = sys.path[1:]
MODULES = (
    "uavnav.cli.worker",
    "uavnav.evaluation",
    "uavnav.views.render",
    "uavnav.report",
    "uavnav.runs.export",
    "pydantic",
)
SERVERS = []
"""That this process has started: one, and none in a fork."""
ROOM = 2000
"""Letters of the server's command line, in which a fork writes its own."""
ALIVE_SECONDS = 1.0
"""Between two looks whether the process that started the server is still there."""


class Popen(subprocess.Popen):
    """As `subprocess.Popen`; a process of this Python is a fork of the server."""

    _server = None

    def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *how):
        words = [os.fspath(word) for word in args] if isinstance(args, (list, tuple)) else []
        # as `engines.logged` writes it
        logged = words[:2] == ["/bin/sh", "-c"] and words[4:5] == [sys.executable]
        log, words = (words[3], words[4:]) if logged else (None, words)
        if words[1:3] == ["-u", "-m"]:
            del words[1]
        if words[:1] != [sys.executable] or words[1:2] == ["-u"]:
            return super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *how)
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._server.connect(address())  # before the environment is told, which then has it
        pipes, (session, group) = how[3:9], how[-2:]
        told = {"words": words[1:], "log": log, "cwd": os.path.abspath(cwd or ".")}
        told |= {"env": dict(os.environ if env is None else env), "session": session, "group": group == 0}
        streams = [
            number if given == -1 else given for number, given in enumerate((pipes[0], pipes[3], pipes[5]))
        ]
        socket.send_fds(self._server, [json.dumps(told).encode()], streams)
        self._close_pipe_fds(*pipes)
        self.pid, self._child_created = self._heard(), True

    def _heard(self):
        return struct.unpack("i", self._server.recv(4))[0]

    def _ended(self, timeout):
        """The status, once there is one."""
        if self.returncode is None and select.select([self._server], [], [], timeout)[0]:
            self.returncode = self._heard()
            self._server.close()
        return self.returncode

    def _internal_poll(self, *how, **more):
        return super()._internal_poll(*how, **more) if self._server is None else self._ended(0)

    def _wait(self, timeout):
        if self._server is None:
            return super()._wait(timeout)
        if self._ended(timeout) is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.returncode


def address():
    """Of the server, which is started where there is none."""
    if ADDRESS not in os.environ:
        name = f"uavnav-{os.getpid()}"
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(f"\0{name}")
            listener.listen(100)
            words = [sys.executable, __file__, str(os.getpid()), " " * ROOM]
            SERVERS.append(Popen.__base__(words, stdin=listener, process_group=0))
        os.environ[ADDRESS] = name
    return f"\0{os.environ[ADDRESS]}"


def serve():
    """Fork for each that asks, as long as the process is there that started this one."""
    starter = int(sys.argv[1])
    for name in MODULES:
        importlib.import_module(name)
    listener = socket.socket(fileno=0)
    listener.settimeout(ALIVE_SECONDS)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that watch
    while os.getppid() == starter:
        with suppress(TimeoutError):
            asked, _ = listener.accept()
            if os.fork() == 0:
                listener.detach()
                return watch(asked)
            asked.close()


def watch(asked):
    """Start a process, and say its number, and at its end its status."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    told, streams, *_ = socket.recv_fds(asked, 2**20, 3)
    told = json.loads(told)
    process = os.fork()
    if process == 0:
        if told.pop("session"):
            os.setsid()
        if told.pop("group"):
            os.setpgid(0, 0)
        asked.send(struct.pack("i", os.getpid()))
        asked.detach()
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
        os.closerange(3, 1024)
        return run(**told)
    os.closerange(0, 3)
    for stream in streams:
        os.close(stream)
    with suppress(BrokenPipeError):  # who asked may be gone
        _, status = os.waitpid(process, 0)
        asked.send(struct.pack("i", os.waitstatus_to_exitcode(status)))
    os._exit(0)


def run(words, log, cwd, env):
    """Be `python WORDS`, from the first word of its program to the end; log: a file for all that it says."""
    os.chdir(cwd)
    if log is not None:
        with open(log, "ab") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
    os.environ.clear()
    os.environ.update(env)
    if "torch._inductor.config" in sys.modules:  # the server has read what was its compiler
        sys.modules["torch._inductor.config"].cpp.cxx = None, os.environ.get("CXX", "g++")
    exec(env.get(FIRST, ""))
    call_oneself(sys.executable, *words)
    sys.stdin, sys.stdout, sys.stderr = (open(number, "rww"[number]) for number in range(3))  # noqa: SIM115
    subprocess.Popen = Popen
    status = 0
    try:
        execute(*words)
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else bool(end.code)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        sys.excepthook(*sys.exc_info())
        status = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # to free all modules takes a second


def call_oneself(*words):
    """Have this process listed by its own command line; setproctitle's way."""
    with open("/proc/self/stat") as facts:
        start, end = (int(fact) for fact in facts.read().rpartition(")")[2].split()[45:47])
    ctypes.memmove(start, b"\0".join(map(os.fsencode, words)).ljust(end - start, b"\0"), end - start)


def execute(kind, *words):
    sys.argv, first = (
        [kind, *words],
        {"-c": "", "-m": os.getcwd()}.get(kind, os.path.dirname(os.path.abspath(kind))),
    )
    sys.path[:] = [first, *PATH]
    if kind == "-c":
        del sys.argv[1]
        main = sys.modules["__main__"] = types.ModuleType("__main__")
        exec(compile(words[0], "<string>", "exec"), main.__dict__)
    elif kind == "-m":
        del sys.argv[1]
        package = hasattr(sys.modules.get(words[0]), "__path__")
        # runpy warns of what is there already
        sys.modules.pop(f"{words[0]}.__main__" if package else words[0], None)
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    serve()
