"""A run's folder: complete, repeatable bit for bit, whole or not there, and never two writers."""

import json
import multiprocessing
import os
import re
import shutil
from pathlib import Path

import pytest
import yaml
from runs_by_hand import same, write_policies

from uavnav import files
from uavnav.algorithms import a2c, dqn, ppo
from uavnav.runs import FILES, POLICY, STOP, Run
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.runs.tables import RunError
from uavnav.tasks import layouts
from uavnav.training.recorder import Interrupted

ALGORITHMS = {"ppo": ppo.train, "dqn": dqn.train, "a2c": a2c.train}


@pytest.fixture(params=list(ALGORITHMS))
def trained(request, of_two):
    return ALGORITHMS[request.param], *of_two(request.param)


@pytest.fixture
def copied(trained, tmp_path):
    """The same with a copy of the run, to train in."""
    train, config, run = trained
    return train, config, Run(shutil.copytree(run.path, tmp_path / "run"))


of_ppo, of_dqn = (pytest.mark.parametrize("trained", [name], indirect=True) for name in ("ppo", "dqn"))
"""Marks of tests of what is the same for all algorithms."""


def test_two_processes_write_one_file_at_once_and_each_time_it_is_whole(tmp_path):
    contents = [bytes([n]) * 100_000 for n in range(2)]
    fork = multiprocessing.get_context("fork")
    writers = [fork.Process(target=write_often, args=(tmp_path / "rows", content)) for content in contents]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        assert not (tmp_path / "rows").exists() or (tmp_path / "rows").read_bytes() in contents
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert [path.name for path in tmp_path.iterdir()] == ["rows"]


def write_often(path, content):
    for _ in range(500):
        files.write(path, content)


def test_the_folder_holds_five_files_and_nothing_else(trained):
    _, _, run = trained
    assert sorted(path.name for path in run.path.iterdir()) == sorted(FILES)


def test_every_world_step_belongs_to_exactly_one_episode_row(trained):
    _, config, run = trained
    episodes = run.episodes
    assert dict(episodes.dtypes.astype(str)) == EPISODE_COLUMNS
    assert episodes.groupby("seed").steps.sum().tolist() == [1024, 1024]
    still_open = episodes[~episodes.terminated & ~episodes.truncated]
    assert (still_open.groupby("seed").size() <= config.n_envs).all()
    assert (still_open.frame == 1024).all()
    for (_, _), rows in episodes.groupby(["seed", "env"]):
        ends = rows.sort_values("frame")
        assert (ends.frame.diff().fillna(ends.frame.iloc[0]) == ends.steps * config.n_envs).all()
        assert (ends.layout.diff().dropna() == 1).all() or (ends.layout.diff() < -9000).any()


def test_a_run_says_what_it_is_and_in_a_notebook_as_a_table(trained):
    _, _, run = trained
    name = run.algorithm
    facts = f"algorithm {name}, activation tanh, seeds 0 to 1, frames 1,024, status finished"
    assert repr(run) == f"Run({run.path}: {facts})"
    assert f"<td>{run.path}</td>" in run._repr_html_()


def test_a_folder_of_runs_names_the_first_few_in_one_line(tmp_path):
    for n in range(30):
        folder = tmp_path / "runs" / "ppo" / f"tanh-{n:02}"
        (folder / "workers" / "0").mkdir(parents=True)
        for place in (folder, folder / "workers" / "0"):
            (place / "config.yaml").touch()
    with pytest.raises(
        RunError, match=r"contains runs and is none; give one of .*tanh-00, .* and \d+ more$"
    ) as told:
        Run(tmp_path / "runs")
    shown = str(told.value).count("tanh-")
    assert str(told.value).endswith(f" and {30 - shown} more")


def test_config_yaml_alone_repeats_the_run(trained, tmp_path):
    _, config, run = trained
    settings = yaml.safe_load((run.path / "config.yaml").read_text())
    assert settings.pop("algorithm") in ALGORITHMS
    assert type(config).from_mapping(settings) == config


def test_meta_names_versions_machine_threads_and_frames(trained):
    _, _, run = trained
    meta = json.loads((run.path / "meta.json").read_text())
    assert meta["status"] == "finished"
    assert meta["frames"] == run.frames == 1024
    assert meta["compiled"] is False
    assert meta["threads"] >= 1
    assert set(meta["versions"]) >= {"python", "torch", "torchrl", "tensordict", "numpy", "uavnav", "world"}
    assert set(meta["machine"]) == {"system", "processor", "cores"}
    assert "git_commit" in meta


def test_a_finished_run_is_returned_at_once_and_untouched(copied):
    train, config, run = copied
    times = {path.name: path.stat().st_mtime_ns for path in run.path.iterdir()}
    again = train(config, out=run.path, quiet=True)
    assert not again.fresh
    assert {path.name: path.stat().st_mtime_ns for path in run.path.iterdir()} == times


@of_ppo
def test_a_finished_run_whose_policy_was_left_out_is_trained_again_to_the_same_bits(trained, tmp_path):
    train, config, run = trained
    folder = shutil.copytree(run.path, tmp_path / "run")
    (folder / POLICY).unlink()
    (folder / "evaluation-test-2-5.parquet").write_bytes(b"rows of the policy that is gone")
    assert Run(folder).episodes.equals(run.episodes)
    again = train(config, out=folder, quiet=True)
    assert again.fresh
    same(run.path, again.path)
    assert again.evaluations() == []
    (folder / POLICY).unlink()
    with pytest.raises(RunError, match="contains a run with lr"):
        train(config.replace(lr=0.5), out=folder, quiet=True)


@of_dqn
def test_a_run_from_before_a_setting_existed_is_one_with_its_default(copied):
    train, config, run = copied
    written = yaml.safe_load((run.path / "config.yaml").read_text())
    assert (written.pop("n_steps"), written.pop("dueling")) == (1, False)
    assert (written.pop("stack"), written.pop("layer_norm")) == (1, False)
    assert not any(written.pop("faults").values())
    (run.path / "config.yaml").write_text(yaml.safe_dump(written))
    assert not train(config, out=run.path, quiet=True).fresh
    for name, default, other in (("n_steps", 1, 3), ("dueling", False, True), ("stack", 1, 2)):
        with pytest.raises(RunError, match=f"contains a run with {name}={default}, not {other}"):
            train(config.replace(**{name: other}), out=run.path, quiet=True)


def test_a_layout_file_is_the_same_setting_by_any_path_finished_or_not_and_another_split_is_not(
    tmp_path, monkeypatch
):
    """Begun by a relative path, gone on by the whole one from elsewhere, asked for by a copy."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name, seed in (("layouts", 3), ("other", 4)):
        layouts.save(layouts.generate(20, 4, seed), name, seed=seed, split="mine")
    shutil.copy("layouts", "copy")

    def train(all_layouts, **more):
        how = {
            "total_frames": 256,
            "frames_per_batch": 64,
            "minibatch_size": 32,
            "n_envs": 4,
            "compile": "off",
        }
        return ppo.train(ppo.PPOConfig(layouts=str(all_layouts), **how), tmp_path / "run", quiet=True, **more)

    with pytest.raises(Interrupted):
        train("layouts", until=128)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match=r"contains a run with layouts=layouts, not .*/here/other"):
        train(tmp_path / "here" / "other")
    whole = train(tmp_path / "here" / "layouts")
    assert whole.fresh
    assert whole.meta["frames"] == 256
    assert not train(tmp_path / "here" / "copy").fresh
    with pytest.raises(RunError, match="contains a run with layouts="):
        train("train")


def test_another_configuration_is_refused_and_nothing_is_lost(copied):
    train, config, run = copied
    before = {path.name: path.read_bytes() for path in run.path.iterdir()}
    with pytest.raises(RunError, match="contains a run with lr="):
        train(type(config)(**vars(config) | {"lr": 0.123}), out=run.path, quiet=True)
    assert {path.name: path.read_bytes() for path in run.path.iterdir()} == before


@of_ppo
def test_a_folder_that_can_be_written_is_taken_though_the_one_above_cannot(trained, tmp_path, monkeypatch):
    train, config, _ = trained
    (tmp_path / "run").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path and access(path, mode))
    assert train(config, out=tmp_path / "run", quiet=True).fresh
    with pytest.raises(RunError, match=f"{tmp_path} is not a folder that can be written"):
        train(config, out=tmp_path / "other", quiet=True)


@of_ppo
def test_overwrite_starts_anew(trained, tmp_path):
    train, config, run = trained
    write_policies(tmp_path / "run", seed=9, n_seeds=2)
    for name in ("evaluation-test-5-20", "arena", "values", "across-density"):
        (tmp_path / "run" / f"{name}.parquet").touch()
    for name in ("across-density-5-20.svg", "transfer-5-20-abc123.png", "notes.svg"):
        (tmp_path / "run" / name).touch()
    (tmp_path / "run" / STOP).touch()  # that the finished run never saw
    (tmp_path / "run" / "checkpoint").mkdir()
    (tmp_path / "run" / "checkpoint" / "state-1-0.safetensors").touch()  # a damaged one
    again = train(config, out=tmp_path / "run", overwrite=True, quiet=True)
    assert not {STOP, "checkpoint"} & {path.name for path in again.path.iterdir()}
    assert again.fresh
    same(again.path, run.path)
    assert {path.name for path in again.path.glob("*.parquet")} == {"episodes.parquet", "progress.parquet"}
    assert [path.name for path in again.path.glob("*.[sp][vn]g")] == ["notes.svg"]


@of_ppo
def test_an_interrupted_run_says_so_and_can_be_run_again(trained, tmp_path, monkeypatch):
    train, config, _ = trained

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ppo, "diagnostics", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(config, out=tmp_path / "run", quiet=True)
    assert json.loads((tmp_path / "run" / "meta.json").read_text())["status"] == "interrupted"
    with pytest.raises(RunError, match="not finished"):
        Run(tmp_path / "run")
    assert train(config, out=tmp_path / "run", quiet=True).frames == 1024


def test_runs_go_to_a_folder_of_their_algorithm_preset_activation_and_what_differs_else():
    assert ppo.PPOConfig(activation="relu").folder == Path("runs/ppo-paper/relu")
    assert dqn.PRESETS["vectorised-2.3"].folder == Path("runs/dqn-vectorised-2.3/tanh")
    fast = ppo.PPOConfig(preset="fast", lr=0.002, n_seeds=4, hidden=(32, 32), task="goal")
    assert fast.folder == Path("runs/ppo-fast/tanh-hidden=32,32-lr=0.002-n_seeds=4-task=goal")
    assert fast.replace(lr=1e-3, world={"sensor_arc": 90}).folder.name.endswith(
        "-task=goal-world.sensor_arc=90"
    )
    odd = [ppo.PPOConfig(layouts=path).folder.name for path in ("some/a.json", "some/b.json", "x" * 81)]
    assert len({*odd}) == 3
    assert all(re.fullmatch("tanh-[0-9a-f]{8}", name) for name in odd)


def test_a_default_folder_that_holds_another_run_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    how = {"total_frames": 128, "frames_per_batch": 128, "epochs": 1, "compile": "off"}
    config = ppo.PPOConfig(**how)
    other = ppo.train(config.replace(lr=0.1), config.folder, quiet=True)
    runs = [ppo.train(config, quiet=True, overwrite=overwrite) for overwrite in (False, False, True)]
    assert [run.fresh for run in runs] == [True, False, True]
    assert {run.path.name[:-8] for run in runs} == {f"{config.folder.name}-"}
    assert len({run.path for run in runs}) == 1
    assert Run(other.path).config["lr"] == 0.1
    with pytest.raises(RunError, match=r"contains a run with lr=0\.1, not 0\.0003; give another folder"):
        ppo.train(config, other.path, quiet=True)


def test_a_run_of_version_0_1_is_refused_in_one_line_and_stays_as_it_is(tmp_path):
    config = ppo.PPOConfig(total_frames=128, frames_per_batch=128, epochs=1, compile="off")
    path = ppo.train(config, tmp_path / "run", quiet=True).path / "config.yaml"
    path.write_text(path.read_text().replace("n_envs:", "n_worlds:"))
    before = path.read_bytes()
    for call in (lambda: Run(path.parent), lambda: ppo.train(config, path.parent, quiet=True)):
        with pytest.raises(RunError, match=r"written by uavnav 0\.1, which reads it; train it again[^\n]*$"):
            call()
    assert path.read_bytes() == before
