"""`import uavnav` is cheap, and every name that it promises is there."""

import subprocess
import sys

import pytest

import uavnav


def test_import_loads_no_torch_and_registers_the_gymnasium_environment():
    code = "import sys, uavnav, gymnasium; print('torch' in sys.modules, 'uavnav/Drone-v0' in gymnasium.registry)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "True"]


@pytest.mark.parametrize("name", uavnav.__all__)
def test_every_public_name_resolves(name):
    assert getattr(uavnav, name) is not None
    assert name in dir(uavnav)


def test_a_name_that_is_not_there_is_answered_with_those_that_are():
    with pytest.raises(AttributeError, match=r"no attribute 'DroneEnvironment'; it has .*DroneEnv"):
        uavnav.DroneEnvironment  # noqa: B018
