import functools

import pytest
import torch

from uavnav import graph

torch.set_num_threads(1)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes more than 30 s on one core")
    config.addinivalue_line("markers", "compiled: needs a compiler, and is skipped where there is none")


@functools.cache
def problem() -> str | None:
    return graph.problem("cpu")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("compiled") and problem():
        pytest.skip(f"nothing can be compiled here: {problem()}")
