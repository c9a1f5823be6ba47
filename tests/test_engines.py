"""A study on each engine: the same rows and weights, whatever dies on the way."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from uavnav.evaluation import evaluate_run
from uavnav.evaluation.verify import _parting as parting
from uavnav.evaluation.verify import _weights
from uavnav.evaluation.verify import _weights_parting as weights_parting
from uavnav.runs import POLICY, Run
from uavnav.studies.engines.local import Local

STUDY = """
what: two configurations of eight seeds
settings:
  {preset: vectorised, n_seeds: 8, total_frames: 12000, hidden: [8], compile: "off", max_steps: 300,
   evaluate: {episodes: 3, max_steps: 50, measures: true}}
configurations:
  - {algorithm: ppo, frames_per_batch: 512, epochs: 1}
"""
SECOND = "  - {algorithm: dqn, n_seeds: 4, learning_starts: 1_000, frames_per_update: 16}\n"
GIVEN = ("seeds_per_worker=4", "checkpoint_seconds=0.5", "report=false")

SECONDS = 290
"""Of a test, after which it fails; with ten other processes on two cores one needs 200."""

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("warm_module")]


class Started:
    """The study in a folder of its own, started as a user does."""

    def __init__(self, folder, text=STUDY):
        (folder / "mine.yaml").write_text(text)
        self.folder, self.out, self.processes = folder, folder / "out", []
        self.limit = time.monotonic() + SECONDS

    def __call__(self, *settings, env=None):
        words = [sys.executable, "-m", "uavnav", "study", "mine.yaml", "out=out", *GIVEN, *settings]
        how = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "process_group": 0}
        process = subprocess.Popen(words, cwd=self.folder, env=os.environ | (env or {}), **how)
        self.processes.append(process)
        return process

    def until(self, condition):
        """What a condition gives, once it gives something."""
        while not (found := condition()):
            assert time.monotonic() < self.limit, self.told()
            time.sleep(0.1)
        return found

    def finished(self, process):
        """What a study says that ends well."""
        said, _ = process.communicate(timeout=max(1.0, self.limit - time.monotonic()))
        assert process.returncode == 0, said
        return said

    def kill(self):
        for process in self.processes:
            process.kill()
            process.wait()
            process.stdout.close()
        signal_all(signal.SIGKILL, self.jobs())

    def jobs(self):
        """Processes of its workers."""
        found = []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                words = (entry / "cmdline").read_bytes().decode().rstrip("\0").split("\0")
            except OSError:
                continue
            if words[0] == sys.executable and "uavnav.cli.worker" in words and str(self.folder) in words[-1]:
                found.append(int(entry.name))
        return found

    def kill_one(self):
        """Kill one of them; whether there was one."""
        for job in self.jobs():
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(job, signal.SIGKILL)
                return True
        return False

    def paused(self, n):
        """Stop its workers, if so many work and none has ended, which none then can; whether that is so."""
        signal_all(signal.SIGSTOP, jobs := self.jobs())
        held = len(jobs) == n and not any(self.out.glob("*/*/workers/*.ended"))
        signal_all(signal.SIGCONT, [] if held else jobs)
        return held

    def snapshots(self):
        """Workers that have one."""
        return {path.parent.parent for path in self.out.glob("*/*/workers/*/checkpoint/state-*")}

    def told(self):
        """What its jobs have said so far."""
        there = self.out.glob("*/*/workers/*")
        return "".join(path.read_text() for path in there if path.suffix in (".log", ".ended"))


@pytest.fixture
def study(tmp_path):
    started = Started(tmp_path)
    yield started
    started.kill()


@pytest.fixture(scope="module")
def alone(once, warm_module):
    """What one machine gives: both configurations, undisturbed; once for all processes."""

    def make(folder):
        started = Started(folder, STUDY + SECOND)
        started.finished(started("checkpoint_seconds=60"))

    return once("alone", make) / "out"


def signal_all(number, processes):
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def assert_same_bits(out, alone, configurations=("ppo/tanh",)):
    for configuration in configurations:
        there, here = Run(alone / configuration), Run(out / configuration)
        assert not parting("episodes", there.episodes, here.episodes)
        assert not parting("progress", there.progress, here.progress)
        (mine, seeds), (theirs, others) = (
            _weights(where / configuration, [POLICY]) for where in (alone, out)
        )
        assert seeds == others
        assert not weights_parting(mine, theirs)
        for name in ("evaluation-test-3-50.parquet", "behaviour-test-3-50.parquet"):
            assert (alone / configuration / name).read_bytes() == (out / configuration / name).read_bytes()
        assert not (out / configuration / "workers").exists()


def test_a_run_notes_its_workers_each_of_one_thread_and_its_study(alone):
    """Four seeds in one process would have two threads elsewhere."""
    metas = [Run(alone / folder).meta for folder in ("ppo/tanh", "dqn/tanh")]
    assert [(meta["processes"], meta["threads"], meta["study"]) for meta in metas] == [
        (2, 1, "mine"),
        (1, 1, "mine"),
    ]


def test_what_workers_have_evaluated_is_the_evaluation_of_all_seeds(alone, tmp_path):
    shutil.copytree(alone / "ppo/tanh", tmp_path / "run")
    evaluate_run(Run(tmp_path / "run"), 3, 50, quiet=True, measures=True)
    for name in ("evaluation-test-3-50.parquet", "behaviour-test-3-50.parquet"):
        assert (alone / "ppo/tanh" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()


def test_when_a_local_engine_closes_what_its_jobs_have_started_ends_too(tmp_path):
    engine = Local()
    (job,) = engine.start([["sh", "-c", f"sleep 300 & echo $! > {tmp_path}/started; wait"]])
    while not (told := tmp_path.joinpath("started")).exists() or not told.read_text():
        assert not engine.ended(job)
    engine.close()
    assert engine.ended(job)
    asked, since = ["ps", "-o", "stat=", "-p", told.read_text().strip()], time.monotonic()
    while subprocess.run(asked, capture_output=True).stdout[:1] not in (b"", b"Z"):
        assert time.monotonic() < since + 60  # a killed process needs a core to end


def test_a_local_study_goes_on_whatever_is_killed(study, alone):
    process = study()
    study.until(study.snapshots)
    old = {*study.jobs()}
    signal_all(signal.SIGSTOP, old)  # cut off, as by the network
    process.kill()
    process.wait()
    process = study()
    new = study.until(lambda: len(new := {*study.jobs()} - old) == 2 and new)
    signal_all(signal.SIGSTOP, new)  # else they may be done before the old ones have noticed
    signal_all(signal.SIGCONT, old)
    study.until(lambda: not old & {*study.jobs()})
    assert "error" in study.told()  # its folder is gone, as its next word or its next snapshot finds
    signal_all(signal.SIGKILL, [process.pid, *study.jobs()])  # the whole tree
    process.wait()
    process = study()
    first, second = study.until(lambda: len(study.jobs()) == 2 and study.jobs())
    os.kill(second, signal.SIGSTOP)
    os.kill(first, signal.SIGKILL)  # one job
    study.until(lambda: len({*study.jobs()} - {first}) == 2)
    os.kill(second, signal.SIGCONT)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=max(1.0, study.limit - time.monotonic()))
    assert "its job is gone; given again, from its last snapshot" in said
    assert process.returncode == 130
    assert said.splitlines()[-1].endswith("stopped by SIGINT; the same command goes on from there")
    assert not study.jobs()
    study.finished(study())
    assert_same_bits(study.out, alone)


def test_a_ray_cluster_that_loses_a_machine_gives_the_same_bits(alone, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    # 15 is Ray's own: other tests would leave its jobs no time
    monkeypatch.setenv("RAY_worker_niceness", "0")
    study = Started(tmp_path, STUDY + SECOND)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        second = cluster.add_node(num_cpus=1)
        process = study("engine=ray", f"address={cluster.address}")
        study.until(lambda: study.snapshots() and study.paused(2))  # one on each machine
        cluster.remove_node(second, allow_graceful=False)
        signal_all(signal.SIGCONT, study.jobs())
        assert "its job is gone; given again" in study.finished(process)
    finally:
        cluster.shutdown()
        study.kill()
    assert_same_bits(study.out, alone, ("ppo/tanh", "dqn/tanh"))


def test_submitits_local_jobs_give_the_same_bits_although_one_is_killed(study, alone):
    pytest.importorskip("submitit")
    process = study("engine=slurm", "cluster=local", "jobs=2")
    study.until(lambda: study.snapshots() and study.kill_one())
    assert "its job is gone; given again" in study.finished(process)
    assert_same_bits(study.out, alone)


SBATCH = """#!{python}
import os, pathlib, re, subprocess, sys
asked = pathlib.Path({folder!r})
script = pathlib.Path(sys.argv[-1]).read_text()
number = len(list(asked.iterdir())) + 1
(asked / f"{{number}}.sh").write_text(script)
array = re.search(r"--array=0-(\\d+)", script)
facts = dict.fromkeys(["SLURM_NODEID", "SLURM_PROCID", "SLURM_LOCALID"], "0")
facts |= {{"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_JOB_NODELIST": "x"}}
for index in range(int(array[1]) + 1) if array else [0]:
    own = {{"SLURM_JOB_ID": str(number)}}
    if array:
        own = {{"SLURM_ARRAY_JOB_ID": str(number), "SLURM_ARRAY_TASK_ID": str(index)}}
    nobody = dict.fromkeys(["stdin", "stdout", "stderr"], subprocess.DEVNULL)
    subprocess.Popen(["/bin/bash", str(asked / f"{{number}}.sh")], env=os.environ | facts | own, **nobody)
print(f"Submitted batch job {{number}}")
"""
SRUN = """#!{python}
import sys
words = sys.argv[sys.argv.index({python!r}):]
sys.path.append({tests!r})
from warm import Popen
sys.exit(Popen(words).wait())
"""


def test_slurm_is_asked_for_an_array_with_partition_time_and_memory(study, alone, tmp_path):
    """By a scheduler of our own on the PATH, which notes what it is asked, and runs it."""
    pytest.importorskip("submitit")
    tools, asked = tmp_path / "tools", tmp_path / "asked"
    asked.mkdir()
    tools.mkdir()
    sbatch = SBATCH.format(python=sys.executable, folder=str(asked))
    srun = SRUN.format(python=sys.executable, tests=str(Path(__file__).parent))
    nothing = "#!/bin/bash\necho 'JobID|State|NodeList'\n"
    for name, text in {"sbatch": sbatch, "srun": srun, "sacct": nothing, "scancel": nothing}.items():
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    path = {"PATH": f"{tools}:{os.environ['PATH']}"}
    study.finished(study("engine=slurm", "partition=long", "time=90", "memory=3", "jobs=4", env=path))
    (array,) = [
        script for script in (file.read_text() for file in asked.iterdir()) if "--array=0-1%2" in script
    ]
    for line in ("--partition=long", "--time=90", "--mem=3GB", "--cpus-per-task=1"):
        assert f"#SBATCH {line}" in array
    assert_same_bits(study.out, alone)
