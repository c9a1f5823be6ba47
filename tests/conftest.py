import functools
import gc
import shutil
import signal
import subprocess
import sys

import pytest
from browsing import chrome, opened, playground  # noqa: F401 - fixtures for all modules of tests
from filelock import FileLock
from warm import Popen, address

import uavnav  # noqa: F401 - before PyTorch, whose threads then wait without spinning


def pytest_configure(config: pytest.Config) -> None:
    # a shell's background job ignores it, its children too
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if config.getoption("numprocesses", None) and sys.platform == "linux":
        address()  # one server for all processes of tests
    config.addinivalue_line("markers", "slow: takes more than 30 s on one core")
    config.addinivalue_line("markers", "compiled: needs a compiler, and is skipped where there is none")


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Tests have no doctests: to look for them, each process would import and search all modules here."""
    return [one for one in (yield) if type(one) is pytest.Module]


def pytest_collectstart() -> None:
    """In the process that collects: the one that hands out tests to others needs no PyTorch."""
    import torch

    torch.set_num_threads(1)


@pytest.fixture
def tmp_path(tmp_path_factory):
    """As pytest's, with a short name: long paths are shortened in messages."""
    return tmp_path_factory.mktemp("t")


@functools.cache
def problem() -> str | None:
    from uavnav import graph

    return graph.problem("cpu")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("compiled") and problem():
        pytest.skip(f"nothing can be compiled here: {problem()}")


@pytest.fixture(scope="session")
def little_garbage():
    """statsmodels collects garbage at every correction of p values; what is there before the tests is
    left out.
    """
    gc.freeze()
    yield
    gc.unfreeze()


def warmed():
    """New processes of Python have imported PyTorch already; see the module `warm`."""
    with pytest.MonkeyPatch.context() as patch:
        if sys.platform == "linux":
            patch.setattr(subprocess, "Popen", Popen)
        yield


warm = pytest.fixture(warmed)
warm_module = pytest.fixture(scope="module")(warmed)
"""For a whole module, and what its tests share."""


@pytest.fixture
def undrawn(monkeypatch):
    """Reports without figures, and with replays of 50 steps instead of 1,000: both take most of the time."""
    from uavnav.views import replays

    monkeypatch.setattr("uavnav.report.figures.draw", lambda *anything: [])
    monkeypatch.setattr(replays.record, "__defaults__", (3, 3, 50))


@pytest.fixture
def brief(monkeypatch):
    """Where no rows of the scripted policy are kept, it flies 20 steps on 2 layouts for a report, not 10,000
    on 200.
    """
    from uavnav.report import compare

    fly, short = compare.fly, {"episodes": 2, "max_steps": 20}
    monkeypatch.setattr(compare, "fly", lambda name, protocol, *more: fly(name, {**protocol, **short}, *more))


@pytest.fixture(scope="session")
def once(tmp_path_factory, request):
    """`once(name, make)`: a folder that `make(folder)` fills, once for all processes of this run of
    pytest.
    """
    root = tmp_path_factory.getbasetemp()
    root = root.parent if hasattr(request.config, "workerinput") else root

    def filled(name, make):
        folder = root / name
        with FileLock(f"{folder}.lock"):
            if not (folder / ".made").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / ".made").touch()
        return folder

    return filled


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """`trained(algorithm)`: a finished run of 256 frames, the same for all tests, and not to be changed."""
    from uavnav.algorithms import ALGORITHMS
    from uavnav.training.loop import train

    more = {"ppo": {"frames_per_batch": 256}, "dqn": {"epsilon_end": 0.5}, "c51": {"epsilon_end": 0.5}}

    @functools.cache
    def run(algorithm):
        config = ALGORITHMS[algorithm].config(total_frames=256, compile="off", **more.get(algorithm, {}))
        return train(config, tmp_path_factory.mktemp(algorithm) / "run", quiet=True)

    return run


@pytest.fixture(scope="session")
def of_two(once):
    """`of_two(algorithm)`: a configuration of two seeds and 1,024 frames, and its finished run, the same for
    all processes and not to be changed.
    """
    from uavnav.algorithms import ALGORITHMS
    from uavnav.runs import Run
    from uavnav.training.loop import train

    more = {
        "ppo": {"frames_per_batch": 512, "epochs": 2},
        "dqn": {"learning_starts": 256, "frames_per_update": 16},
        "a2c": {"n_steps": 4},
    }
    small = {"preset": "vectorised", "total_frames": 1024, "n_seeds": 2, "compile": "off"}

    @functools.cache
    def found(algorithm):
        config = ALGORITHMS[algorithm].config(**small, **more[algorithm])
        folder = once(f"two-{algorithm}", lambda folder: train(config, folder / "run", quiet=True))
        return config, Run(folder / "run")

    return found


@pytest.fixture
def results(tmp_path):
    """A folder of run folders written by hand."""
    from runs_by_hand import write_results

    return write_results(tmp_path / "results")


@pytest.fixture(scope="session")
def gathered(tmp_path_factory):
    """What a report without figures says of such a folder; not to be changed."""
    from runs_by_hand import write_results

    from uavnav.report.content import gather

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavnav.report.figures.draw", lambda *anything: [])
        return gather([write_results(tmp_path_factory.mktemp("report") / "results")])
