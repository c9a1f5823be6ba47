"""Tuning: the same trials whatever kills the study, the same number and ranges for all; training itself
is made up.
"""

import functools
import itertools
import json
import math
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from uavnav import studies
from uavnav.algorithms.ppo import PPOConfig
from uavnav.cli import commands, study, worker
from uavnav.errors import ConfigError
from uavnav.evaluation import Protocol
from uavnav.runs import trials
from uavnav.runs.policies import Diverged, PolicyError
from uavnav.runs.tables import RunError, lock
from uavnav.studies import search, tuning
from uavnav.training import workers

main = functools.partial(commands.run, "study")

optuna = pytest.importorskip("optuna")

SMALL = """
what: two settings of two algorithms
tune:
  trials: 14
  at_once: 3
  settings: {preset: vectorised, activation: tanh, n_seeds: 2, total_frames: 2000,
    evaluate: {episodes: 5, max_steps: 50}}
  ranges: {rate: {low: 1.0e-5, high: 1.0e-2, log: true}, width: [32, 64, 128], passes: {low: 1, high: 20}}
  space:
    ppo: {lr: rate, hidden: width, epochs: passes}
    a2c: {lr: rate, hidden: width}
settings: {seed: 100, preset: vectorised, n_seeds: 3, total_frames: 4000}
configurations:
  - {algorithm: [ppo, a2c], folder: tuning/default}
"""
DIVERGES = 5e-3
"""A learning rate above which the made-up training diverges."""


class Killed(BaseException):
    """As SIGKILL, nothing after it is done."""


def planned(folder, text=SMALL, trials=None, **given):
    path = folder / "small.yaml"
    path.write_text(text)
    return search.plan(studies.read(str(path), **given), folder / "out", trials)


def value(config):
    """Of a made-up run: best at a rate of 1e-3 and 64 units."""
    return -abs(math.log10(config.lr) + 3) - abs(config.hidden[0] - 64) / 64


def train(configurations):
    """Leave the rows that episodes would leave, and return what diverged."""
    failed = []
    for configuration in configurations:
        configuration.out.mkdir(parents=True, exist_ok=True)
        if configuration.config.lr > DIVERGES:
            failed.append(SimpleNamespace(configuration=configuration, diverged=True))
            continue
        modes = {"mode": ["greedy", "sampled", "sampled"], "reward": [99.0, 1.0, -1.0]}
        rows = pd.DataFrame(modes)
        rows["reward"] += value(configuration.config)
        rows.to_parquet(configuration.out / configuration.episodes[0])
    return failed


def tuned(folder, **given):
    found = planned(folder, **given)
    assert tuning.tune(found, train, say=lambda line: None) == []
    return [(found.folder / name).read_bytes() for name in ("trials.csv", "importance.csv")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a study that has ended."""
    folder = tmp_path_factory.mktemp("unbroken")
    tuned(folder)
    return folder


@pytest.fixture(scope="module")
def unbroken(whole):
    return [(whole / "out" / "tuning" / name).read_bytes() for name in ("trials.csv", "importance.csv")]


def test_each_algorithm_gets_the_same_number_of_trials_the_first_with_its_defaults(whole):
    table = search.trials(planned(whole))
    assert table.groupby("algorithm")["trial"].apply(list).to_dict() == {
        "a2c": [*range(14)],
        "ppo": [*range(14)],
    }
    first = {row.algorithm: json.loads(row.settings) for row in table[table["trial"] == 0].itertuples()}
    assert first == {"ppo": {"lr": 3e-4, "hidden": 64, "epochs": 10}, "a2c": {"lr": 7e-4, "hidden": 64}}


def test_a_trial_is_told_the_mean_reward_of_its_sampled_episodes_and_the_best_wins(whole):
    found = planned(whole)
    table = search.trials(found)
    for row in table[table["state"] == "finished"].itertuples():
        configuration = found.trial(row.algorithm, row.trial, json.loads(row.settings))
        assert row.value == pytest.approx(value(configuration.config))
    for configuration in search.winners(found):
        mine = table[table["algorithm"] == configuration.config.algorithm]
        assert value(configuration.config) == pytest.approx(mine["value"].max())
        assert (configuration.config.seeds, configuration.config.total_frames) == ([100, 101, 102], 4000)
        number = mine.loc[mine["value"].idxmax(), "trial"]
        assert (
            configuration.out == found.out / f"tuning/tuned/{number:03}/{configuration.config.algorithm}/tanh"
        )


def test_a_trial_that_diverges_is_told_as_failed_and_the_study_goes_on(whole):
    table = search.trials(planned(whole))
    rates = table["settings"].map(lambda settings: json.loads(settings)["lr"])
    assert (rates > DIVERGES).any()
    assert ((table["state"] == "diverged") == (rates > DIVERGES)).all()
    assert table["value"].isna().equals(rates > DIVERGES)


@pytest.mark.parametrize(
    ("error", "diverged"),
    [(Diverged, True), (PolicyError, False), (RunError, False), (ValueError, False), (OSError, False)],
)
def test_a_worker_whose_weights_are_not_finite_diverged_and_one_that_cannot_fly_otherwise_did_not(
    error, diverged, tmp_path, monkeypatch
):
    def flown(*given, **how):
        raise error("policy.0.weight of seed 3")

    monkeypatch.setattr(worker, "STOPS", ())
    monkeypatch.setattr(worker.loop, "alone", lambda *given, **how: SimpleNamespace(frames=64))
    monkeypatch.setattr(worker, "evaluate_run", flown)
    own = workers.Worker(tmp_path / "0", PPOConfig())
    worker.main(own.prepare(1, {"episodes": 1}))
    said = {"diverged": False} | workers.last_words(own.file("ended"))
    assert said == {"error": "policy.0.weight of seed 3", "diverged": diverged}


@pytest.mark.parametrize(
    "said", [None, "", "{", "[]", "3", "{}", '{"out": 3, "folder": ".", "evaluation": null}']
)
def test_a_damaged_job_of_a_worker_is_answered_in_one_line(said, tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "STOPS", ())
    job = tmp_path / "0.job"
    if said is not None:
        job.write_text(said)
    with pytest.raises(SystemExit, match=r"0\.job: missing or damaged; give the same command again, "):
        worker.main(["uavnav.algorithms.ppo:PPOConfig", str(job)])
    assert [*tmp_path.iterdir()] == [job] * (said is not None)


def stopped(tmp_path, monkeypatch, after, leave=lambda journal: None):
    """A study that is killed after so many writes of its journal, which is then left as a function leaves
    it.
    """
    backend = optuna.storages.journal.JournalFileBackend
    writes, whole = itertools.count(1), backend.append_logs

    def killed(self, logs):
        whole(self, logs)
        if next(writes) >= after:
            leave(tmp_path / "out" / "tuning" / "journal.jsonl")
            raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(backend, "append_logs", killed)
        with pytest.raises(Killed):
            tuned(tmp_path)


@pytest.mark.parametrize("after", [1, 3, 12, 40, 55])
def test_a_study_killed_after_any_write_ends_with_the_trials_of_an_unbroken_one(
    after, tmp_path, unbroken, monkeypatch
):
    """Also where the kill comes while a trial is asked for, between two that are told, or in training."""
    stopped(tmp_path, monkeypatch, after)
    assert tuned(tmp_path) == unbroken


def test_a_study_whose_journal_is_cut_off_in_mid_line_ends_with_the_same_trials(
    tmp_path, unbroken, monkeypatch
):
    """As a full disk or a lost machine leaves it."""
    stopped(tmp_path, monkeypatch, 12, leave=lambda journal: journal.write_bytes(journal.read_bytes()[:-20]))
    assert tuned(tmp_path) == unbroken


def test_a_trial_that_was_under_way_is_trained_again_with_the_same_settings_in_the_same_folder(tmp_path):
    seen = []

    def dies(configurations):
        seen.append([(configuration.out, configuration.config) for configuration in configurations])
        raise Killed

    for _ in range(2):
        with pytest.raises(Killed):
            tuning.tune(planned(tmp_path), dies)
    assert seen[0] == seen[1]
    assert len(seen[0]) == 2 * 3


def test_trials_that_fail_otherwise_are_not_told_and_come_back(tmp_path):
    def full(configurations):
        return [SimpleNamespace(configuration=configurations[0], diverged=False)]

    assert len(tuning.tune(planned(tmp_path), full)) == 1
    assert search.trials(planned(tmp_path)).empty


def test_a_study_whose_trials_fail_counts_them_and_not_its_configurations(tmp_path, capsys, monkeypatch):
    class Full(study.Runner):
        def run(self):
            return [study.Work(work.configuration, problem="the disk is full") for work in self.works[:5]]

    monkeypatch.setattr(study, "Runner", Full)
    (tmp_path / "small.yaml").write_text(SMALL)
    assert main([str(tmp_path / "small.yaml"), f"out={tmp_path / 'out'}"]) == 1
    assert capsys.readouterr().err == "uavnav study: 5 trials failed; the same command repeats them\n"


def test_more_trials_go_on_where_fewer_ended(tmp_path):
    tuned(tmp_path, trials=2)
    few = search.trials(planned(tmp_path))
    tuned(tmp_path, trials=5)
    many = search.trials(planned(tmp_path))
    assert (len(few), len(many)) == (4, 10)
    assert many.groupby("algorithm").head(2)["settings"].tolist() == few["settings"].tolist()


def test_another_winner_after_more_trials_is_another_run(tmp_path):
    """Else the run of the one before would stand as its own."""
    tuned(tmp_path, trials=2)
    before = {
        configuration.config.algorithm: configuration for configuration in search.winners(planned(tmp_path))
    }
    tuned(tmp_path)
    after = {
        configuration.config.algorithm: configuration for configuration in search.winners(planned(tmp_path))
    }
    changed = [name for name in after if after[name].config != before[name].config]
    assert changed
    assert all((after[name].out != before[name].out) == (name in changed) for name in after)


def test_algorithms_that_are_searched_one_after_the_other_have_all_rows(tmp_path, unbroken):
    found = planned(tmp_path)
    for name in ("a2c", "ppo"):
        assert (
            tuning.tune(found._replace(study=studies.only(found.study, name)), train, say=lambda line: None)
            == []
        )
    for name, both in zip(("trials.csv", "importance.csv"), unbroken, strict=True):
        assert sorted((found.folder / name).read_bytes().splitlines()) == sorted(both.splitlines())


def test_importance_is_a_share_of_each_setting_and_the_one_that_decides_leads(whole):
    table = pd.read_csv(whole / "out" / "tuning" / "importance.csv")
    assert table.groupby("algorithm")["importance"].sum().tolist() == pytest.approx([1.0, 1.0])
    (passes,) = table.loc[table["setting"] == "epochs", "importance"]
    assert passes < 0.2  # the made-up training does not look at it


def test_the_packages_search_gives_all_algorithms_the_same_budget_and_a_shared_setting_the_same_range(
    tmp_path,
):
    study = studies.read("tuning")
    found = search.plan(study, tmp_path)
    assert found.algorithms == ["ppo", "dqn", "a2c", "c51", "sac"]
    assert (found.trials, found.said["settings"]["n_seeds"], found.said["settings"]["total_frames"]) == (
        40,
        2,
        200_000,
    )
    configuration = found.trial("sac", 0, {})
    assert configuration.evaluations == (Protocol("validation", 100, 2000),)
    ranges = {}
    for algorithm, setting in ((a, s) for a in found.algorithms for s in found.said["space"][a]):
        ranges.setdefault(setting, []).append(found.range(algorithm, setting))
    for setting in ("lr", "gamma", "hidden"):
        assert len(ranges[setting]) == 5
    assert all(one == of[0] for of in ranges.values() for one in of)
    assert found.range("ppo", "minibatch_size") == found.range("dqn", "batch_size")
    defaults = [
        configuration
        for configuration in studies.configurations(study, tmp_path)
        if configuration.config.algorithm == "sac"
    ]
    assert defaults[0].config.seeds == [*range(100, 110)]
    assert defaults[0].config.total_frames == 1_000_000


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("at_once: 3", "at_onec: 3"), "tune: there is no key 'at_onec'"),
        (("trials: 14", "trials: many"), "tune: trials=many; give it as uavnav/studies/tuning.yaml does"),
        (
            ("hidden: width}", "hidden: widht}"),
            "tune: range=widht; did you mean width? choose from passes, rate, width",
        ),
        (("lr: rate, hidden: width}", "lrr: rate}"), "there is no key 'lrr'"),
        (("[32, 64, 128]", "[32, 128]"), "width=[32, 128]; the default of ppo, hidden=64, is not in it"),
        (("[32, 64, 128]", "64"), "width=64; give a list of values, or low and high"),
        (("a2c: {", "sac: {"), "tune: algorithm=a2c; did you mean sac? choose from ppo, sac"),
        (("low: 1,", "low: 0,"), "epochs=0; give a number of at least 1"),
        (
            ("low: 1.0e-5", "low: 0.0"),
            "'log': True}; give numbers, low below high, and low above 0 with log: true",
        ),
        (("low: 1.0e-5", "low: small"), "give numbers, low below high"),
        (("low: 1,", "low: 30,"), "passes={'low': 30, 'high': 20}; give numbers, low below high"),
        (
            ("ppo: {lr: rate, hidden: width, epochs: passes}", "ppo: lr"),
            "tune: space: ppo=lr; give settings with the",
        ),
        (("epochs: passes}", "task: passes}"), "task=1"),
        (("epochs: passes}", "3: passes}"), "tune: there is no key '3'; choose from "),
        (("epochs: passes}", "max_steps: passes}"), "the default of ppo, max_steps=None, is not in it"),
        (
            ("epochs: passes}", "max_grad_norm: [passes]}"),
            "range=['passes']; did you mean passes? choose from passes, rate, width",
        ),
        (("at_once: 3", "at_once: -3"), "tune: at_once=-3; give it as uavnav/studies/tuning.yaml does"),
        (
            ("    a2c: {", "    pop: {lr: rate}\n    a2c: {"),
            "tune: algorithm=pop; did you mean ppo? choose from a2c, ",
        ),
        (
            ("activation: tanh", "activation: [tanh, relu]"),
            "tune: ppo: a trial is one configuration, not 2; give one value",
        ),
        (
            ("evaluate: {episodes: 5, max_steps: 50}", "evaluate: false"),
            "tune: settings: evaluate=false; a trial is",
        ),
        (
            ("evaluate: {episodes: 5, max_steps: 50}", "dqn: 3"),
            "tune: dqn=3; give keys and values",
        ),
        (
            ("{seed: 100, ", "{seed: 1, "),
            "tune: ppo: seed=1 is of trials and of what they are compared in; give",
        ),
        (
            (SMALL.partition("settings: {seed")[0], "tune: 3\n"),
            "tune=3; give keys and values, as uavnav/studies/tuning",
        ),
    ],
)
def test_a_wrong_plan_is_refused_in_one_line(change, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(SMALL.replace(*change))
    assert main(["small.yaml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_more_seeds_than_lie_between_trials_and_winners_are_refused(tmp_path):
    assert planned(tmp_path, seeds=100).study.given == {"n_seeds": 100}
    with pytest.raises(ConfigError, match="ppo: seed=100 is of trials and of what they are compared in"):
        planned(tmp_path, seeds=101)


def test_a_folder_of_another_search_and_one_that_is_in_use_are_refused(tmp_path):
    tuned(tmp_path, trials=1)
    with pytest.raises(
        ConfigError, match=r"journal\.jsonl: contains the trials of another search; give another out="
    ):
        tuned(tmp_path, trials=1, frames=3000)
    found = planned(tmp_path, trials=1)
    with lock(found.folder), pytest.raises(RunError, match="another process"):
        tuning.tune(found, train)


@pytest.mark.parametrize("content", [b"{\n}\n{}\n", b"{}\n", b"\xff\n", b"[]\n", b'{"op_code":\n'])
def test_a_journal_that_is_damaged_is_one_line(content, tmp_path):
    found = planned(tmp_path)
    found.folder.mkdir(parents=True)
    (found.folder / "journal.jsonl").write_bytes(content)
    with pytest.raises(RunError, match=r"journal\.jsonl: cannot be read"):
        tuning.tune(found, train)


def test_a_missing_optuna_names_the_extra(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(["tuning", f"out={tmp_path / 'out'}"]) == 2
    assert capsys.readouterr().err == (
        "uavnav study: a study that tunes needs Optuna; pip install 'uavnav[tune]' brings it\n"
    )


def test_the_status_counts_trials_and_needs_no_optuna(monkeypatch, tmp_path, capsys):
    tuned(tmp_path, trials=3)
    monkeypatch.setitem(sys.modules, "optuna", None)
    out, path = tmp_path / "out", tmp_path / "small.yaml"
    assert main([str(path), f"out={out}", "algorithms=ppo", "trials=4", "--status", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    table = search.trials(planned(tmp_path))
    best = trials.best(table, "ppo")["trial"]
    folders = [str(Path(row["configuration"]).relative_to(out / "tuning")) for row in rows]
    assert folders == [
        "default/ppo/tanh",
        *(f"trials/{n:03}/ppo/tanh" for n in range(4)),
        f"tuned/{best:03}/ppo/tanh",
    ]
    told = table.loc[table["algorithm"] == "ppo", "state"].tolist()
    assert [row["state"] for row in rows] == ["missing", *told, "missing", "missing"]


def test_trials_are_asked_of_a_study_that_tunes_and_algorithms_of_one_that_has_them(capsys):
    assert main(["paper", "trials=3"]) == 2
    told = "uavnav study: trials=3: study paper neither tunes nor draws; leave it out\n"
    assert capsys.readouterr().err == told
    assert main(["paper", "algorithms=sac"]) == 2
    assert "algorithms=sac; choose from dqn, ppo" in capsys.readouterr().err
    assert len(studies.configurations(studies.only(studies.read("paper"), "ppo"), Path("out"))) == 4


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
def test_a_real_study_killed_with_signal_9_ends_as_an_unbroken_one_bit_for_bit(tmp_path):
    text = SMALL.replace("trials: 14", "trials: 2").replace(
        "n_seeds: 3, total_frames: 4000", "n_seeds: 1, total_frames: 500"
    )
    text = text.replace("n_seeds: 2", "n_seeds: 1").replace(
        "{seed: 100,", "{seed: 100, evaluate: {episodes: 2, max_steps: 20},"
    )
    (tmp_path / "small.yaml").write_text(text)

    def study(out):
        words = ["small.yaml", f"out={out}", "algorithms=a2c", "report=false", "checkpoint_seconds=0"]
        command = [sys.executable, "-m", "uavnav", "study", *words]
        return subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    assert study("whole").wait(300) == 0
    first = study("killed")
    deadline = time.monotonic() + 240
    while (
        not [*tmp_path.glob("killed/tuning/trials/*/a2c/tanh/**/progress.json")]
        and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    first.kill()
    first.wait()
    assert not (tmp_path / "killed/tuning/trials.csv").exists()
    assert study("killed").wait(300) == 0
    (winner,) = tmp_path.glob("whole/tuning/tuned/*/a2c/tanh/policy.safetensors")
    for name in ("tuning/trials.csv", "tuning/importance.csv", winner.relative_to(tmp_path / "whole")):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes(), name
