"""A study's folder that only some machines see is found out before any work, on clusters made up here."""

import math
import socket
import subprocess
import sys
import types

import pytest

from uavnav.errors import ConfigError
from uavnav.studies import engines

SBATCH = """#!{python}
import pathlib, os, re, subprocess, sys
text = pathlib.Path(sys.argv[-1]).read_text()
jobs = pathlib.Path({jobs!r})
number = len(list(jobs.iterdir())) + 1
named = re.search(r"--nodelist=(\\S+)", text)
machine = named[1] if named else "first"
if machine == "small":
    sys.exit("sbatch: error: Requested node configuration is not available")
state = {{"blind": "FAILED", "bare": "FAILED", "busy": "PENDING"}}.get(machine, "RUNNING")
(jobs / str(number)).write_text(state)
if machine == "bare":
    error = pathlib.Path(re.search(r"--error=(\\S+)", text)[1].replace("%j", str(number)))
    error.write_text("no python here")
if machine in ("first", "second"):
    facts = dict.fromkeys(["SLURM_NODEID", "SLURM_PROCID", "SLURM_LOCALID"], "0")
    facts |= {{"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_JOB_NODELIST": "x"}}
    facts |= {{"SLURM_JOB_ID": str(number)}}
    nobody = dict.fromkeys(["stdin", "stdout", "stderr"], subprocess.DEVNULL)
    subprocess.Popen(["bash", sys.argv[-1]], env=os.environ | facts, **nobody)
print("Submitted batch job", number)
"""
SACCT = """#!{python}
import pathlib
print("JobID|State|NodeList")
for job in pathlib.Path({jobs!r}).iterdir():
    print(f"{{job.name}}|{{job.read_text()}}|x")
"""
SRUN = """#!/bin/bash
while [[ "$1" == -* ]]; do case "$1" in --output|--error) shift;; esac; shift; done
exec "$@"
"""


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """An engine on a cluster of machines: first and second see every folder, blind sees none, bare lacks
    Python.
    """
    pytest.importorskip("submitit")
    from uavnav.studies.engines import slurm

    monkeypatch.setattr(slurm, "SACCT_SECONDS", 0)
    monkeypatch.setattr(engines.Probe, "SECONDS", 0.5)
    (tmp_path / "tools").mkdir()
    (tmp_path / "jobs").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "tools"), prepend=":")

    def build(machines, **settings):
        listed = "#!/bin/bash\necho '" + "\n".join(machines) + "'\n"
        texts = {"sbatch": SBATCH, "sacct": SACCT, "srun": SRUN, "scancel": "#!/bin/bash\n", "sinfo": listed}
        for name, text in texts.items():
            how = {"python": sys.executable, "jobs": str(tmp_path / "jobs")}
            (tmp_path / "tools" / name).write_text(text.format(**how) if "{python}" in text else text)
            (tmp_path / "tools" / name).chmod(0o755)
        return slurm.Slurm(**settings)

    return build


def asked(tmp_path):
    return len([*(tmp_path / "jobs").iterdir()])


@pytest.mark.parametrize(
    ("machine", "said"),
    [
        (
            "blind",
            "out={out}: the machine blind of the SLURM cluster does not see it; give a folder that all "
            "machines",
        ),
        ("bare", "engine=slurm: the machine bare of the SLURM cluster has no {python}; install uavnav there"),
    ],
)
def test_slurms_free_machines_are_asked_one_by_one(machine, said, slurm, tmp_path):
    engine = slurm(["first cpu*", "second cpu*", f"{machine} cpu*"])
    with pytest.raises(ConfigError) as refused:
        engine.check(tmp_path / "out")
    assert str(refused.value).startswith(said.format(out=tmp_path / "out", python=sys.executable))
    assert asked(tmp_path) == 4  # one of them wherever SLURM likes


def test_slurms_machines_elsewhere_too_small_or_busy_hinder_nothing(slurm, tmp_path):
    engine = slurm(["second cpu", "small cpu", "busy cpu", "first gpu*", "blind gpu*"], partition="cpu")
    engine.check(tmp_path / "out")
    assert asked(tmp_path) == 3
    engine.check(tmp_path / "out")  # a study that tunes asks again and again
    assert asked(tmp_path) == 3
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["slurm"]


class Cluster:
    """What the engine asks of Ray. Machine `blind` has a folder of the same path on its own disk."""

    exceptions = types.SimpleNamespace(RayError=RuntimeError)

    def __init__(self, folder, disk, *machines):
        self.folder, self.disk, self.machines = str(folder), str(disk), machines

    def nodes(self):
        named = [(name, name.encode().hex().ljust(56, "0")) for name in self.machines]
        return [{"NodeID": key, "NodeManagerHostname": name, "Alive": name != "dead"} for name, key in named]

    def remote(self, function):
        def call(asked, machine):
            if machine == "blind" and function is subprocess.call:
                return function(
                    [word.replace(self.folder, self.disk) for word in asked], stderr=subprocess.DEVNULL
                )
            return function(asked) and not (machine == "bare" and asked == sys.executable)

        def named(key):
            return bytes.fromhex(key).rstrip(b"\0").decode()

        def options(num_cpus, scheduling_strategy):
            return types.SimpleNamespace(
                remote=lambda asked: (call, asked, named(scheduling_strategy.node_id))
            )

        return types.SimpleNamespace(options=options)

    def get(self, tasks, timeout):
        if any(machine == "silent" for *_, machine in tasks):
            raise RuntimeError
        return [call(asked, machine) for call, asked, machine in tasks]


@pytest.mark.parametrize(
    ("machine", "said"),
    [
        (
            "blind",
            "out={out}: the machine blind of the Ray cluster does not see it; give a folder that all "
            "machines",
        ),
        ("bare", "engine=ray: the machine bare of the Ray cluster has no {python}; install uavnav there"),
        ("silent", "engine=ray: the machine silent of the Ray cluster does not answer"),
        ("dead", None),
    ],
)
def test_every_living_machine_of_a_ray_cluster_is_asked(machine, said, tmp_path):
    pytest.importorskip("ray")
    from uavnav.studies.engines.ray import Ray

    out, disk = tmp_path / "out", tmp_path / "disk"
    disk.mkdir()
    out.mkdir()
    engine = object.__new__(Ray)
    engine._ray = Cluster(out, disk, "first", "second", machine)
    if said is None:
        engine.check(out)
    else:
        with pytest.raises(ConfigError) as refused:
            engine.check(out)
        assert str(refused.value).startswith(said.format(out=out, python=sys.executable))
    assert not [*out.iterdir()]


@pytest.fixture
def cluster(monkeypatch):
    """Ray with the machines `living` and `gone`, of one CPU each; Ray has not seen that the second does
    not answer.
    """
    ray = pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as door, socket.socket() as shut:
        shut.bind(("127.0.0.1", 0))  # and listens to nobody
        doors = {"living".ljust(56, "0"): door, "gone".ljust(56, "0"): shut}
        nodes = [
            {"NodeID": key.encode().hex()[:56], "Alive": True, "Resources": {"CPU": 1.0}}
            | dict(zip(("NodeManagerAddress", "NodeManagerPort"), where.getsockname(), strict=True))
            for key, where in doors.items()
        ]
        head = ":".join(map(str, door.getsockname()))
        given = []

        def options(scheduling_strategy, **how):
            def begin(words):
                given.append(bytes.fromhex(scheduling_strategy.node_id).decode().rstrip("0"))
                return f"job {len(given)}"

            return types.SimpleNamespace(remote=begin)

        for name, stand_in in {
            "init": lambda **how: None,
            "get_runtime_context": lambda: types.SimpleNamespace(gcs_address=head),
            "nodes": lambda: nodes,
            "remote": lambda call: types.SimpleNamespace(options=options),
            "wait": lambda jobs, **how: ([], jobs),
            "available_resources": dict,
        }.items():
            monkeypatch.setattr(ray, name, stand_in)
        strategy = types.SimpleNamespace(node_id=nodes[0]["NodeID"])
        yield types.SimpleNamespace(head=head, given=given, nodes=nodes, strategy=strategy)


def test_a_machine_that_does_not_answer_gets_no_job_of_ray(cluster):
    from uavnav.studies.engines.ray import Ray

    engine = Ray(cluster.head)
    assert engine.slots() == 1
    engine.start([["first"], ["second"]])
    assert cluster.given == ["living", "living"]


def test_a_job_of_ray_that_waits_behind_another_is_queued_and_ends_with_its_machine(cluster):
    from uavnav.studies.engines.ray import Ray

    engine = Ray(cluster.head)
    first, second = engine.start([["first"], ["second"]])
    assert not engine.queued(first)
    assert engine.queued(second)
    engine.cancel(first)
    assert not engine.queued(second)
    assert not engine.ended(second)
    cluster.nodes[0]["Alive"] = False
    engine._seen = 0.0
    assert engine.ended(second)


def test_a_machine_of_rays_where_a_job_did_not_begin_is_the_last_to_get_it_again(cluster):
    from uavnav.studies.engines.ray import Ray

    engine = Ray(cluster.head)
    engine._machines()
    engine._answering = {"first": 1, "second": 1}
    engine._seen = math.inf
    strategies = []
    engine._only = lambda machine: strategies.append(machine) or cluster.strategy
    (job,) = engine.start([["first"]])
    engine.cancel(job)
    engine.start([["again"], ["another"]])
    assert strategies == ["first", "second", "first"]
