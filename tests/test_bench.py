"""The benchmarks' jobs, the command that runs them, and the file that it writes; no test judges a speed."""

import inspect
import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import pytest
import torch

from uavnav import evaluation
from uavnav.algorithms import ALGORITHMS
from uavnav.bench import ours, page, peers, plain, runner, sections, worlds
from uavnav.bench.jobs import Job, JobError
from uavnav.bench.page import read_sections
from uavnav.bench.plan import Measurement
from uavnav.bench.runner import Runner
from uavnav.cli import bench as bench

pytestmark = pytest.mark.usefixtures("warm_module")

# -- jobs -------------------------------------------------------------------------------------------------------------


def test_a_job_that_fails_says_why_in_one_line_and_one_that_takes_too_long_is_ended(tmp_path):
    job = Job("worlds.single", {"which": "numpy", "seconds": "soon"}, 1, tmp_path)
    slow = Job("worlds.single", {"which": "numpy", "seconds": 600}, 1, tmp_path)
    with pytest.raises(JobError, match="it took longer than 0 s"):
        slow.result(timeout=0.1)
    assert slow._process.returncode is not None
    with pytest.raises(JobError, match="TypeError") as failed:
        job.result(timeout=60)
    assert "\n" not in str(failed.value)
    job.stop()


def test_a_job_ends_when_the_one_that_started_it_is_killed(tmp_path):
    command = (
        "import sys, time, pathlib; from uavnav.bench.jobs import Job;"
        f"job = Job('worlds.single', {{'which': 'numpy', 'seconds': 600}}, 1, pathlib.Path({str(tmp_path)!r}));"
        "print(job._process.pid, flush=True); time.sleep(600)"
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
        "import sys, time, pathlib; from uavnav.bench.worlds import _meet; time.sleep(float(sys.argv[1]));"
        f"began = time.time(); _meet(pathlib.Path({str(tmp_path)!r}), '4096', 2); print(began, time.time())"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", command, delay], stdout=subprocess.PIPE, text=True)
        for delay in ("0", "0.5")
    ]
    spans = [[float(word) for word in process.communicate(timeout=120)[0].split()] for process in both]
    assert max(came for came, _ in spans) < min(went_on for _, went_on in spans)


@pytest.mark.parametrize(
    ("algorithm", "frames", "more"),
    [
        ("ppo", 8192, {"frames_per_batch": 256, "epochs": 1}),
        ("dqn", 40_000, {"learning_starts": 10_000, "frames_per_update": 64}),
    ],
)
def test_a_watched_run_of_ours_is_stopped_and_names_its_rates(algorithm, frames, more, monkeypatch):
    given = []
    monkeypatch.setattr(ours.os, "sched_setaffinity", lambda process, cores: given.append(cores), raising=False)
    found = ours.watched(0.0, algorithm, 1, 0.0, stages=True, compile="off", **more)
    assert [len(cores) for cores in given] == [1]
    assert found["frames"] <= frames
    assert found["rate"] > 0
    assert 0.99 < sum(found["shares"].values()) < 1.01
    assert found["shares"]["collection"] > 0
    assert found["shares"]["update"] > 0


class FakeRun:
    """A run whose mean reward is 90 after 30,000 frames and -10 before."""

    def __init__(self, folder):
        self.reward = 90.0 if int(Path(folder).name) >= 30_000 else -10.0


@pytest.mark.parametrize(("patience", "seconds", "frames"), [(100.0, 3.0, 30_000), (2.5, None, None)])
def test_the_first_policy_that_is_good_after_training_anew_up_to_its_frame_is_found(
    patience, seconds, frames, monkeypatch
):
    import pandas as pd

    from uavnav.runs import policies

    now = [0.0]
    monkeypatch.setattr(ours.time, "time", lambda: now[0])
    trained, held_out = [], []

    def watch(algorithm, config, out, keep_on):
        Path(out).mkdir()
        Path(out, "meta.json").write_text("{}")
        for second in range(10):  # a look every half a second
            for now[0] in (float(second), second + 0.5):
                if not keep_on(10_000 * second):
                    return
            now[0] = second + 0.5

    def judge(policy, bank, episodes, max_steps):
        held_out.append(len(bank))
        return pd.DataFrame({"reward": [policy.reward]})

    monkeypatch.setattr(ours, "watch", watch)
    monkeypatch.setattr(ours, "train", lambda algorithm, config, out: trained.append(config.total_frames))
    monkeypatch.setattr(policies, "load_policy", lambda folder, greedy: FakeRun(folder))
    monkeypatch.setattr(evaluation, "evaluate_policy", judge)
    found = ours.reach(0.0, "ppo", "fast", 5, 88.5, 200, patience)
    assert found == {"seed": 5, "seconds": seconds, "frames": frames}
    assert set(held_out) == {200}
    assert trained == [10_000, 20_000, 30_000][: len(trained)]


@pytest.mark.parametrize(("algorithm", "rows"), [("sac", 64), ("c51", 32)])
def test_a_peer_in_plain_pytorch_is_watched_for_three_looks_once_it_is_steady(algorithm, rows, monkeypatch):
    learned = []
    kind = plain.AGENTS[algorithm]
    update = kind.update
    monkeypatch.setattr(kind, "update", lambda agent, batch: learned.append(batch) or update(agent, batch))
    found = plain.watched(0.0, algorithm, "numpy", 400, 0.0, learning_starts=300, buffer_size=350)
    assert found["frames"] == 600  # those after 400, 500 and 600
    assert len(learned) == 75
    assert [part.shape for part in learned[-1]] == [(rows, 30), (rows, 1), (rows,), (rows, 30), (rows,)]
    assert min(found["rate"], found["rate_before"]) > 0


def test_the_agent_in_plain_pytorch_moves_all_its_parts_towards_what_is_paid():
    """Action 3 of 100 is paid, in one place: the policy then takes it there, at a temperature that has fallen."""
    torch.manual_seed(0)
    agent = plain.Agent(ours.settings("sac", lr=1e-2, gamma=0.0, target_entropy=0.2, tau=0.5))
    action = torch.arange(100)[:, None]
    place = torch.ones(100, 30)
    batch = (place, action, (action[:, 0] == 3).float(), place, torch.ones(100))
    for _ in range(200):
        agent.update(batch)
    assert agent.policy(batch[0]).softmax(-1)[:, 3].mean() > 0.5
    assert agent.log_alpha.item() < -1
    assert all((target(batch[0]) - network(batch[0])).abs().max() < 0.1 for target, network in agent.pairs)


def test_c51_in_plain_pytorch_learns_what_an_action_is_worth_now_and_a_step_ahead():
    """Action 3 of 100 is paid 1, in one place, and half of the best follows: it is worth 2 there, any other 1."""
    torch.manual_seed(0)
    config = ours.settings("c51", lr=1e-2, gamma=0.5, target_update_frames=4, epsilon_end=0.0)
    agent, action, place = plain.Distributional(config), torch.arange(100)[:, None], torch.ones(100, 30)
    batch = (place, action, (action[:, 0] == 3).float(), place, torch.zeros(100))
    agent.atoms = torch.linspace(-3, 3, config.n_atoms)  # eq. (14)'s own end at 0.18
    for _ in range(300):
        agent.update(batch)
    values = (agent.probabilities(agent.network, place[0]) * agent.atoms).sum(-1)
    assert values[3].item() == pytest.approx(2, abs=0.1)
    assert values[[0, 50, 99]].tolist() == pytest.approx([1] * 3, abs=0.1)
    assert agent.act(place[0].numpy()) == 3
    agent.update((*batch[:4], torch.ones(100)))  # where the episode ends, the reward alone counts
    assert values[3].item() > (agent.probabilities(agent.network, place[0]) * agent.atoms).sum(-1)[3].item()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [name for name in peers.SPEED_UPS if name not in peers.PLAIN])
def test_where_the_time_goes_is_taken_of_stable_baselines3_too(algorithm, tmp_path):
    pytest.importorskip("stable_baselines3")
    how = {"which": "numpy", "frames": 2048, "seconds": 0.5, "learning_starts": 500, "stages": True}
    job = Job("peers.watched", {"algorithm": algorithm} | how, 1, tmp_path)  # what is timed stays wrapped
    shares = job.result(timeout=300)["shares"]
    job.stop()
    assert sum(shares.values()) == pytest.approx(1)
    assert min(shares["collection"], shares["update"], shares["buffer"]) > 0


def test_stable_baselines3s_a2c_has_the_settings_and_the_80_frames_an_update_of_ours():
    pytest.importorskip("stable_baselines3")
    a2c = peers.make_model("stable_baselines3", "a2c", worlds.make_env("numpy"), 0)
    assert (a2c.n_steps, a2c.learning_rate, a2c.gamma, a2c.gae_lambda) == (80, 7e-4, 0.99, 1.0)
    assert (a2c.vf_coef, a2c.ent_coef, a2c.max_grad_norm, a2c.normalize_advantage) == (0.5, 0.0, 0.5, False)
    assert (type(a2c.policy.optimizer).__name__, a2c.policy.optimizer.defaults["eps"]) == ("RMSprop", 1e-5)


def test_stable_baselines3_is_given_the_preset_paper_with_1_and_with_16_parallel_worlds():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env = DroneVecEnv(16, seed=0)
    ppo = peers.make_model("stable_baselines3", "ppo", env, 0, 16)
    assert (ppo.n_steps, ppo.batch_size, ppo.n_epochs, ppo.gae_lambda) == (128, 64, 10, 0.95)
    assert (ppo.clip_range(1), ppo.ent_coef, ppo.vf_coef, ppo.max_grad_norm, ppo.learning_rate) == (
        0.2,
        0,
        0.5,
        0.5,
        3e-4,
    )
    dqn = peers.make_model("stable_baselines3", "dqn", env, 0, 16, activation="relu")
    assert (dqn.train_freq.frequency, dqn.gradient_steps, dqn.target_update_interval) == (1, 4, 10_000)
    assert (dqn.learning_starts, dqn.batch_size, dqn.max_grad_norm, dqn.learning_rate) == (50_000, 32, 10, 1e-4)
    alone = peers.make_model("stable_baselines3", "dqn", worlds.make_env("numpy"), 0, buffer_size=100)
    assert (alone.train_freq.frequency, alone.gradient_steps, alone.target_update_interval) == (4, 1, 10_000)
    assert "in_features=30, out_features=64" in repr(dqn.q_net)
    assert "ReLU" in repr(dqn.q_net)
    assert "Tanh" in repr(alone.q_net)


@pytest.mark.slow
def test_the_benchmarks_start_without_any_peer_installed():
    code = (
        "import sys; sys.modules.update({'stable_baselines3': None, 'sbx': None, 'jax': None});"
        "from uavnav.bench.__main__ import BY_DEFAULT, plan; print(len(plan(BY_DEFAULT, True)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(result.stdout) > 20


# -- running them -----------------------------------------------------------------------------------------------------


def test_a_process_that_fails_does_not_end_the_one_beside_it(tmp_path):
    kept = tmp_path / "kept"
    code = {"which": "numpy", "seconds": 0.05}
    one = Measurement("gymnasium/numpy", "worlds.single", [{"which": "numpy", "seconds": "soon"}, code])
    kept.mkdir()
    ended = []

    class Watched(Job):
        def result(self, timeout):
            found = super().result(timeout)
            ended.append(found)
            return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "Job", Watched)
        with pytest.raises(JobError, match="TypeError"):
            Runner(tmp_path, print).measure(one)
    assert [set(found) for found in ended] == [{"rate", "peak"}]


def test_a_failed_measurement_is_named_and_the_others_go_on(tmp_path, monkeypatch):
    def measure(self, one):
        if one.name == "world/a":
            raise JobError("no memory")
        return [{"1": 5.0}]

    said = []
    monkeypatch.setattr(Runner, "measure", measure)
    results = Runner(tmp_path, said.append).run([Measurement(f"world/{name}", "", [{}], rounds=2) for name in "ab"])
    assert results.missing == {"world/a": "failed: no memory"}
    assert results.sums("world/b", "1") == [5.0, 5.0]
    assert len(said) == 4


def test_caches_are_warmed_once_with_the_changed_arguments_and_that_round_is_not_kept(tmp_path, monkeypatch):
    measured = []

    def measure(self, one):
        measured.append(one.processes[0]["seconds"])
        return [{"rate": 1.0}]

    monkeypatch.setattr(Runner, "measure", measure)
    one = Measurement("training/x", "ours.watched", [{"seconds": 5.0}], rounds=2, warm={"seconds": 0.0})
    assert Runner(tmp_path, print).run([one]).values("training/x", "rate") == [1.0, 1.0]
    assert measured == [0.0, 5.0, 5.0]


# -- the plan and the command -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("quick", [False, True])
def test_every_measurement_of_the_plan_names_a_job_and_arguments_that_it_takes(quick):
    names = bench.QUICK if quick else list(sections.SECTIONS)
    every = bench.plan(names, quick)
    assert len({one.name for one in every}) == len(every)
    assert {one.name.split("/")[0] for one in every} | {"parity"} == {*names, "parity"}  # all its rows may be there
    for one in every:
        module, function = one.job.split(".")
        signature = inspect.signature(getattr(import_module(f"uavnav.bench.{module}"), function))
        for arguments in one.processes:
            signature.bind(0.0, **arguments | ({"meeting": "", "copies": 2} if one.together else {}))
            signature.bind(0.0, **arguments | one.warm)
            how = {key: value for key, value in arguments.items() if key not in signature.parameters}
            if module == "ours":  # what is left are settings
                ours.settings(arguments["algorithm"], **how)
    assert all(one.rounds == 1 for one in every if quick)


def test_a_buffer_is_measured_where_there_is_one_and_fast_where_frames_alone_make_the_policy():
    assert [ours.has_buffer(name) for name in ("ppo", "dqn")] == [False, True]
    assert [ours.has_fast(name) for name in ("ppo", "dqn")] == [True, False]
    assert set(peers.SPEED_UPS) <= set(ALGORITHMS)


def test_the_command_measures_one_thing_in_a_process_of_its_own_and_writes_the_file(tmp_path, monkeypatch, capsys):
    def tiny(names, quick):
        return [
            Measurement("gymnasium/numpy", "worlds.single", [{"which": "numpy", "seconds": 0.05}], rounds=1),
            Measurement("training/ppo/sbx/numpy", "peers.watched", [{}], needs="sbx", rounds=1),
        ]

    monkeypatch.setattr(bench, "plan", tiny)
    real = runner.importlib.util.find_spec
    monkeypatch.setattr(runner.importlib.util, "find_spec", lambda name: None if name == "sbx" else real(name))
    monkeypatch.chdir(tmp_path)
    out = Path("build/bench/quick.md")
    assert bench.main(["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "1/2 gymnasium/numpy: rate" in lines[0]
    assert "2/2 training/ppo/sbx/numpy: SBX is not installed: pip install -e '.[bench]'" in lines[1]
    assert lines[2] == f"wrote {out}"
    found = read_sections(out)
    assert not Path("docs").exists()
    assert list(found) == ["machine", "gymnasium", "training"]
    assert "one round each" in found["gymnasium"].splitlines()[2]
    assert "| the NumPy world, `gymnasium.make` |" in found["gymnasium"]
    assert "SBX is not installed: pip install -e '.[bench]'" in found["training"]


STUBS = {
    "worlds.batched": lambda how: {str(batch): 1e6 for batch in how["batches"]},
    "worlds.single": lambda how: {"rate": 1e4},
    "worlds.vector": lambda how: {str(batch): 1e4 for batch in how["batches"]},
    "ours.whole": lambda how: {"whole": 90.0, "frames": 10**6},
    "ours.reach": lambda how: {"seed": how["seed"], "seconds": 20.0 + how["seed"], "frames": 200_000},
}
"""What each job finds; runs that are watched find the rest."""


def stubbed(one):
    watched = {"startup": 9.0, "rate": 2e3, "rate_before": 1e4, "whole": 600.0, "frames": 60_000}
    watched |= {"shares": {"collection": 0.5, "update": 0.4, "other": 0.1}}
    return [{"peak": 1.0} | (STUBS[one.job](how) if one.job in STUBS else watched) for how in one.processes]


@pytest.fixture
def stubs(monkeypatch, tmp_path):
    """The names of what is measured, none of it really."""
    measured = []

    def measure(self, one):
        measured.append(one.name)
        return stubbed(one)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Runner, "measure", measure)
    real = runner.importlib.util.find_spec
    monkeypatch.setattr(runner.importlib.util, "find_spec", lambda name: name in runner.PEERS or real(name))
    return measured


@pytest.mark.parametrize(
    ("words", "written"),
    [
        ([], ["machine", "targets", *bench.BY_DEFAULT]),
        (["--quick"], ["machine", "targets", *bench.QUICK]),
        (["--only", "stages"], ["machine", "stages"]),
        (["--only", "growth"], ["growth"]),
        (["--only", "parity"], ["parity"]),
        (["--only", "parity", "world"], ["machine", "world", "parity"]),
    ],
)
def test_every_mode_writes_its_sections_to_the_end(stubs, words, written):
    assert bench.main(words) == 0
    out = Path("build/bench/quick.md" if "--quick" in words else "docs/benchmarks.md")
    found = read_sections(out)
    assert list(found) == written
    assert out.read_text().endswith("\n")
    assert "cut short" not in out.read_text()
    assert "not measured" not in found.get("targets", "") or "--quick" in words
    pictures = [f"benchmarks-{name}.png" for name in ("growth", "parity") if name in written]
    assert sorted(path.name for path in out.parent.glob("*.png")) == pictures
    assert all(f"]({picture})" in out.read_text() for picture in pictures)


def test_two_runs_leave_each_others_sections(stubs):
    assert bench.main(["--only", "growth"]) == 0
    growth = read_sections(Path("docs/benchmarks.md"))["growth"]
    assert bench.main(["--only", "memory"]) == 0
    found = read_sections(Path("docs/benchmarks.md"))
    assert list(found) == ["machine", "memory", "growth"]
    assert found["growth"] == growth
    assert page.machine() in growth


@pytest.mark.parametrize("words", [[], ["--only", "growth"], ["--only", "fast"]])
def test_a_run_that_is_stopped_in_its_third_measurement_writes_what_it_found_and_marks_it(
    stubs, words, monkeypatch, capsys
):
    def measure(self, one):
        stubs.append(one.name)
        if len(stubs) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        return stubbed(one)

    monkeypatch.setattr(Runner, "measure", measure)
    before = {number: signal.getsignal(number) for number in bench.STOPS}
    try:
        assert bench.main(words) == 130
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert len(stubs) == 3
    assert "stopped; what was found so far is in docs/benchmarks.md" in capsys.readouterr().err
    found = read_sections(Path("docs/benchmarks.md"))
    assert found
    assert all("cut short" in text for text in found.values())
    assert "targets" not in found


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--only", "wrld"], "(did you mean world?)"),
        (["--only"], "expected at least one argument"),
        (["--quik"], "--quik"),
        (["--out", "."], "is a folder"),
    ],
)
def test_each_of_4_bad_arguments_ends_in_one_line_and_status_2(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        status = bench.main(words)
    except SystemExit as stop:
        status = stop.code
    errors = capsys.readouterr().err
    assert status == 2
    assert errors.startswith("uavnav bench: ")
    assert errors.count("\n") == 1
    assert says in errors
