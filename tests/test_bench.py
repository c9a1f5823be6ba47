"""The benchmarks' jobs, the command that runs them, and the file that it writes; no test judges a speed."""

import importlib.util
import inspect
import os
import signal
import subprocess
import sys
import time
from argparse import Namespace
from importlib import import_module
from pathlib import Path

import pytest

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import BY_DEFAULT, LONGER, QUICK, environments, jobs, plan, training
from uavnav.bench.jobs import JobError
from uavnav.bench.page import machine, read_sections
from uavnav.bench.plan import Measurement
from uavnav.cli import bench, commands

pytestmark = pytest.mark.usefixtures("warm_module")

NUMPY = Measurement("gymnasium/numpy", "environments.single", {"which": "numpy", "seconds": 0.05}, rounds=1)

# -- jobs ----------------------------------------------------------------------------------------------------


def test_a_job_that_takes_too_long_is_ended(tmp_path, monkeypatch):
    started = []
    popen = jobs.subprocess.Popen
    monkeypatch.setattr(
        jobs.subprocess, "Popen", lambda *args, **how: started.append(popen(*args, **how)) or started[-1]
    )
    with pytest.raises(JobError, match="it took longer than 0 s"):
        jobs.measure(NUMPY, {"which": "numpy", "seconds": 600}, tmp_path, timeout=0.1)
    assert started[0].returncode == -signal.SIGKILL


def test_a_process_that_fails_says_why_in_one_line_and_ends_the_one_beside_it(tmp_path):
    one = Measurement(
        "world/two", "environments.batched", {"batches": [1], "meeting": "", "copies": 3}, copies=2
    )
    began = time.monotonic()
    with pytest.raises(JobError, match="TypeError") as failed:
        jobs.measure(one, one.arguments | {"settings": 7}, tmp_path)
    assert "\n" not in str(failed.value)
    assert time.monotonic() - began < environments.PATIENCE


def test_two_processes_meet_and_their_rates_are_added_and_other_numbers_averaged(tmp_path, monkeypatch):
    arguments = {"batches": [1, 2], "compiled": False, "seconds": 0.01, "meeting": "", "copies": 2}
    one = Measurement("world/two", "environments.batched", arguments, copies=2)
    found = jobs.measure(one, arguments, tmp_path)
    assert set(found) == {"rate", "1", "2", "peak"}
    assert found["peak"] > 0
    results = iter(
        [{"rate": 1.0, "8": 2.0, "whole": 4.0, "how": "1"}, {"rate": 2.0, "8": 3.0, "whole": 6.0, "how": "1"}]
    )
    monkeypatch.setattr(jobs, "_found", lambda job, said: next(results))
    monkeypatch.setattr(jobs, "memory", lambda session: 1.5)
    joined = jobs.measure(one, arguments, tmp_path)
    assert joined == {"rate": 3.0, "8": 5.0, "whole": 5.0, "how": "1", "peak": 1.5}


def test_a_job_ends_when_the_one_that_started_it_is_killed(tmp_path):
    command = (
        "import sys, pathlib; from uavnav.bench import jobs; popen = jobs.subprocess.Popen;"
        "tell = lambda job: print(job.pid, flush=True) or job;"
        "jobs.subprocess.Popen = lambda *args, **how: tell(popen(*args, **how));"
        "one = jobs.Measurement('', 'environments.single', {'which': 'numpy', 'seconds': 600});"
        f"jobs.measure(one, one.arguments, pathlib.Path({str(tmp_path)!r}))"
    )
    process = subprocess.Popen([sys.executable, "-c", command], stdout=subprocess.PIPE, text=True)
    with process:
        job = Path(f"/proc/{process.stdout.readline().strip()}")
        assert job.exists()
        process.kill()
    for _ in range(300):
        if not job.exists() or (job / "stat").read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.1)
    else:
        pytest.fail("the job still runs")


def test_of_two_processes_that_meet_the_first_waits_for_the_second(tmp_path):
    command = (
        "import sys, time, pathlib; from uavnav.bench.environments import _meet;"
        " time.sleep(float(sys.argv[1]));"
        f"began = time.time(); _meet(pathlib.Path({str(tmp_path)!r}), '4096', 2); print(began, time.time())"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", command, delay], stdout=subprocess.PIPE, text=True)
        for delay in ("0", "0.5")
    ]
    spans = [[float(word) for word in process.communicate(timeout=240)[0].split()] for process in both]
    assert max(came for came, _ in spans) < min(went_on for _, went_on in spans)


@pytest.mark.parametrize(
    ("algorithm", "more"),
    [
        ("ppo", {"frames_per_batch": 256, "epochs": 1}),
        ("dqn", {"learning_starts": 10_000, "frames_per_update": 64}),
    ],
)
def test_a_watched_run_of_ours_is_stopped_and_names_its_rate(algorithm, more):
    found = training.ours(0.0, algorithm, 0.0, compile="off", **more)
    assert found["frames"] <= 40_000
    assert found["rate"] > 0


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_stable_baselines3_has_every_setting_of_our_preset_paper(algorithm):
    pytest.importorskip("stable_baselines3")
    model, config = (
        training.make_model(
            training.SB3, training.settings(algorithm, "paper"), environments.make_env("numpy")
        ),
        training.settings(algorithm, "paper"),
    )
    theirs = {
        "lr": model.learning_rate,
        "gamma": model.gamma,
        "max_grad_norm": model.max_grad_norm,
        "hidden": tuple(model.policy.net_arch),
    }
    if algorithm == "dqn":
        theirs |= {
            "buffer_size": model.buffer_size,
            "learning_starts": model.learning_starts,
            "batch_size": model.batch_size,
            "frames_per_update": model.train_freq.frequency,
            "target_update_frames": model.target_update_interval,
            "exploration_fraction": model.exploration_fraction,
            "epsilon_end": model.exploration_final_eps,
        }
        assert model.gradient_steps == 1
        assert "Tanh" in repr(model.q_net)
    else:
        assert model.n_steps == config.frames_per_iteration
        theirs |= {
            "gae_lambda": model.gae_lambda,
            "critic_coeff": model.vf_coef,
            "entropy_coeff": model.ent_coef,
        }
        assert "Tanh" in repr(model.policy)
    if algorithm == "ppo":
        theirs |= {
            "minibatch_size": model.batch_size,
            "epochs": model.n_epochs,
            "clip_epsilon": model.clip_range(1),
        }
        theirs |= {"adam_eps": model.policy.optimizer.defaults["eps"]}
    if algorithm == "a2c":
        assert type(model.policy.optimizer).__name__.startswith("RMSprop")
        assert not model.normalize_advantage
        theirs |= {"rms_eps": model.policy.optimizer.defaults["eps"]}
    assert {name: getattr(config, name) for name in theirs} == theirs


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_stable_baselines3_in_16_environments_updates_after_as_many_frames_as_ours(algorithm):
    vector = pytest.importorskip("stable_baselines3.common.vec_env")
    config = training.settings(algorithm, "paper", n_envs=16)
    env = vector.DummyVecEnv([lambda: environments.make_env("numpy")] * 16)
    model = training.make_model(training.SB3, config, env)
    if algorithm == "dqn":
        frames, updates = 16 * model.train_freq.frequency, model.gradient_steps
        assert (frames, updates) == (16, 4) == (config.frames_per_iteration, config.updates_per_step)
    else:
        assert 16 * model.n_steps == config.frames_per_iteration


@pytest.mark.slow
def test_stable_baselines3_is_watched_in_a_process_of_its_own(tmp_path):
    pytest.importorskip("stable_baselines3")
    one = Measurement("training/A2C, SB3", "training.peer", {"algorithm": "a2c", "seconds": 0.5})
    found = jobs.measure(one, one.arguments, tmp_path)
    assert min(found["rate"], found["peak"]) > 0  # start-up is what a short, uneven rate leaves over


# -- running them --------------------------------------------------------------------------------------------


def test_a_failed_measurement_is_named_and_the_others_go_on(tmp_path, monkeypatch):
    def measure(one, arguments, cache):
        if one.name == "world/a":
            raise JobError("failed: no memory")
        return {"1": 5.0}

    said = []
    monkeypatch.setattr(jobs, "measure", measure)
    both = [Measurement(f"world/{name}", "", {}, rounds=2) for name in "ab"]
    results = jobs.run(both, tmp_path, said.append)
    assert results.missing == {"world/a": "failed: no memory"}
    assert results.rows == [(both[1], 0, {"1": 5.0}), (both[1], 1, {"1": 5.0})]
    assert len(said) == 4


def test_caches_are_warmed_once_with_the_changed_arguments_and_that_round_is_not_kept(tmp_path, monkeypatch):
    measured = []
    monkeypatch.setattr(
        jobs, "measure", lambda one, arguments, cache: measured.append(arguments) or {"rate": 1.0}
    )
    one = Measurement("training/x", "training.ours", {"seconds": 5.0}, rounds=2, warm={"seconds": 0.0})
    assert [found for _, _, found in jobs.run([one], tmp_path, print).rows] == [{"rate": 1.0}] * 2
    assert [arguments["seconds"] for arguments in measured] == [0.0, 5.0, 5.0]


# -- the plan and the command --------------------------------------------------------------------------------


EVERY = [*BY_DEFAULT, *LONGER]


@pytest.mark.parametrize("quick", [False, True])
def test_every_measurement_of_the_plan_names_a_job_and_arguments_that_it_takes(quick):
    every = plan.plan(QUICK if quick else EVERY, quick)
    names = {one.name for one in every}
    assert len(names) == len(every)
    assert {one.name.split("/")[0] for one in every} == set(QUICK if quick else EVERY)
    for one in every:
        assert one.base in names | {""}
        module, function = one.job.split(".")
        signature = inspect.signature(getattr(import_module(f"uavnav.bench.{module}"), function))
        signature.bind(0.0, **one.arguments | one.warm)
        how = {key: value for key, value in one.arguments.items() if key not in signature.parameters}
        if how:  # settings
            training.settings(one.arguments["algorithm"], **how)
    assert all(one.rounds == 1 for one in every if quick)


def test_each_algorithm_is_measured_beside_sb3s_if_there_is_one_and_with_a_full_buffer_if_there_is_one():
    names = [one.name for one in plan.plan(EVERY, False)]
    assert [name for name in names if name.startswith("memory/")] == [
        "memory/DQN",
        "memory/C51",
        "memory/SAC",
    ]
    assert [name for name in names if name.endswith(", SB3")] == [
        f"training/{name.upper()}, SB3" for name in plan.IN_SB3
    ]
    assert all(f"training/{name.upper()}, uavnav, 1 seed" in names for name in ALGORITHMS)


def test_the_command_measures_one_thing_in_a_process_of_its_own_and_writes_the_file(
    tmp_path, monkeypatch, capsys
):
    sbx = Measurement("training/PPO, SBX", "training.peer", {}, needs="sbx", rounds=1)
    monkeypatch.setattr(bench, "plan", lambda names, quick: [NUMPY, sbx])
    real = importlib.util.find_spec
    monkeypatch.setattr(jobs.importlib.util, "find_spec", lambda name: None if name == "sbx" else real(name))
    monkeypatch.chdir(tmp_path)
    out = Path("build/bench/quick.md")
    assert commands.run("bench", ["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "1/2 gymnasium/numpy: rate" in lines[0]
    assert "2/2 training/PPO, SBX: SBX is not installed: pip install -e '.[bench]'" in lines[1]
    assert lines[2] == f"wrote {out}"
    found = read_sections(out)
    assert not Path("docs").exists()
    assert list(found) == ["", "gymnasium", "training"]
    assert "one round each" in found["gymnasium"]
    assert "| numpy | " in found["gymnasium"]
    assert "SBX is not installed: pip install -e '.[bench]'" in found["training"]


def stubbed(one):
    """What a job could find."""
    found = {"startup": 9.0, "rate": 2e3, "whole": 600.0, "frames": 60_000, "peak": 1.0}
    return found if one.name.startswith("training") else {"rate": 1e4, "frames": 10**6, "peak": 1.0}


@pytest.fixture
def stubs(monkeypatch, tmp_path):
    """The names of what is measured, none of it really."""
    measured = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jobs, "measure", lambda one, *how: measured.append(one.name) or stubbed(one))
    return measured


@pytest.mark.parametrize(
    ("words", "written"),
    [
        ([], BY_DEFAULT),
        (["--quick"], QUICK),
        (["--only", "memory"], ["memory"]),
        (["--only", "tasks", "world"], ["world", "tasks"]),
    ],
)
def test_every_mode_writes_its_sections_to_the_end(stubs, words, written):
    assert commands.run("bench", words) == 0
    out = Path("build/bench/quick.md" if "--quick" in words else "docs/benchmarks.md")
    assert list(read_sections(out)) == ["", *written]
    assert out.read_text().endswith("|\n")
    assert "cut short" not in out.read_text()


def test_two_runs_leave_each_others_sections(stubs):
    assert commands.run("bench", ["--only", "tasks"]) == 0
    found = read_sections(Path("docs/benchmarks.md"))["tasks"]
    assert commands.run("bench", ["--only", "memory"]) == 0
    assert list(read_sections(Path("docs/benchmarks.md"))) == ["", "memory", "tasks"]
    assert read_sections(Path("docs/benchmarks.md"))["tasks"] == found
    assert machine() in found


@pytest.mark.parametrize("words", [[], ["--only", "tasks"]])
def test_a_run_that_is_stopped_in_its_third_measurement_writes_what_it_found_and_marks_it(
    stubs, words, monkeypatch, capsys
):
    def measure(one, *how):
        stubs.append(one.name)
        if len(stubs) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        return stubbed(one)

    monkeypatch.setattr(jobs, "measure", measure)
    before = {number: signal.getsignal(number) for number in bench.STOPS}
    try:
        assert commands.run("bench", words) == 130
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert len(stubs) == 3
    assert "stopped; what was found so far is in docs/benchmarks.md" in capsys.readouterr().err
    found = read_sections(Path("docs/benchmarks.md"))
    assert list(found) == ["", words[-1] if words else "world"]
    assert "cut short" in found[words[-1] if words else "world"]


@pytest.mark.parametrize("which", ["collection", "updates"])
def test_of_a_part_one_iteration_is_measured_also_where_only_the_caches_are_warmed(which, monkeypatch):
    learned = []
    config = Namespace(frames_per_iteration=8, n_seeds=2, make=lambda compiled: trainee)
    trainee = Namespace(actor=None, learn=lambda batch, frames: learned.append(frames))
    monkeypatch.setattr(training, "settings", lambda algorithm, **changed: config)
    monkeypatch.setattr(training, "products", lambda config: {which: 6e9})
    monkeypatch.setattr(training, "make_training_env", lambda config, compiled: None)
    monkeypatch.setattr(training, "make_collector", lambda env, actor, config: iter(range(100)))
    found = training.part(0.0, "ppo", 0.0, which)
    assert learned == [8, 16, 24]  # two to warm up
    assert found["gflops"] == pytest.approx(found["rate"] / 16 * 6)


def test_the_products_of_an_iteration_are_counted_as_by_hand():
    """Two seeds in one environment: 64 steps of a 30-8-100 policy; then an epoch of its losses and values."""
    config = training.settings(
        "ppo", "paper", n_seeds=2, frames_per_batch=64, minibatch_size=32, epochs=1, hidden=(8,)
    )
    policy, value = 2 * (30 * 8 + 8 * 100), 2 * (30 * 8 + 8 * 1)
    first = 2 * 30 * 8  # no gradient of an observation is asked for
    found = training.products(config)
    assert found["collection"] == 2 * 64 * policy
    around = 2 * 64 * (2 * policy + 2 * value)  # log-probabilities and values before, diagnostics after
    learned = 2 * 64 * (3 * (policy + value) - 2 * first)
    assert found["updates"] == around + learned
