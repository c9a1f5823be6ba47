"""Plugins: the file of docs/extending.md trains, is noted, and is imported where its name is given and
nowhere else.
"""

import hashlib
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from runs_by_hand import write_policies
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import uavnav
from uavnav import ConfigError, PolicyError, Run, load_policy, plugins
from uavnav.algorithms import ALGORITHMS, ppo
from uavnav.cli import commands, worker
from uavnav.runs import POLICY
from uavnav.tasks.table import TASKS

pytestmark = pytest.mark.usefixtures("warm_module")

ROOT = Path(uavnav.__file__).parent.parent
PAGE = (ROOT / "docs" / "extending.md").read_text()
TRAIN, *OTHERS = (
    line.split()[1:] for line in re.search(r"```bash\n(.*?)```", PAGE, re.DOTALL)[1].splitlines()
)
RUN = "runs/mine"
PARTS = {"activation": "hardswish", "reward": "roomy", "task": "narrow"}
SHORT = {
    "n_seeds": 2,
    "n_envs": 16,
    "total_frames": 1024,
    "frames_per_batch": 512,
    "hidden": [8],
    "compile": "off",
}
WORDS = [f"{key}={value}".replace(" ", "") for key, value in SHORT.items()]


def python(folder, *words, err=""):
    """A process in a folder: what it printed; it must end well and complain of nothing else."""
    command = [sys.executable, *map(str, words)]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, err), result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Holds my_study.py of the docs, and the run that the first command there made of it."""
    folder = tmp_path_factory.mktemp("plugins")
    (code,) = re.findall(r'```python title="my_study.py"\n(.*?)```', PAGE, re.DOTALL)
    (folder / "my_study.py").write_text(code)
    said = python(folder, "-m", "uavnav", *TRAIN, *WORDS, "evaluate=false")
    assert "reinforce hardswish, preset paper: 2 seeds (0 to 1), 1,024 frames each" in said
    assert f"\ncompare it:   uavnav compare {RUN} reactive --plugins my_study\n" in said
    assert said.endswith(" plugins=my_study\n")
    return folder


@pytest.fixture(scope="module")
def run(folder):
    return Run(folder / RUN)


def header_of(path):
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["uavnav"])


# -- training ------------------------------------------------------------------------------------------------


def test_a_run_notes_its_plugins_by_name_and_hash_and_the_world_of_its_task(folder, run):
    sha = hashlib.sha256((folder / "my_study.py").read_bytes()).hexdigest()
    assert run.meta["plugins"] == {"my_study": sha}
    header = header_of(run.path / POLICY)
    assert header["plugins"] == ["my_study"]
    assert {key: header[key] for key in PARTS} == PARTS
    assert header["world"]["sensor_arc"] == 90
    assert run.config["world"]["sensor_arc"] == 90


TOGETHER_AND_ALONE = """
import pytest
import uavnav
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted

uavnav.plugins.load("my_study")
import my_study
how = dict(n_seeds=2, n_envs=16, total_frames=1024, frames_per_batch=512, hidden=[8], compile="off",
    activation="hardswish", reward="roomy", task="narrow")
for name, config in ("ppo", uavnav.ppo.PPOConfig(epochs=1, **how)), ("reinforce", my_study.Config(**how)):
    with pytest.raises(Interrupted):
        train(config, out=f"spread/{name}-1", quiet=True, until=512)
    for n in (1, 2):
        run = train(config, out=f"spread/{name}-{n}", quiet=True, processes=n)
        assert run.meta.get("processes", 1) == n, run.meta
"""


@pytest.mark.slow
def test_in_the_processes_of_workers_a_plugins_parts_and_algorithm_give_what_one_process_gives(folder):
    """And what is stopped there goes on as if it had not been."""
    python(folder, "-c", TOGETHER_AND_ALONE)
    for name in ("ppo", "reinforce"):
        alone, together = (Run(folder / "spread" / f"{name}-{n}") for n in (1, 2))
        pd.testing.assert_frame_equal(alone.episodes, together.episodes)
        assert alone.meta["plugins"] == together.meta["plugins"]
        first, second = (load_file(one.path / POLICY) for one in (alone, together))
        assert first.keys() == second.keys()
        # products of 1 and 2 agents
        assert max(float((first[key] - second[key]).abs().max()) for key in first) < 1e-6
        assert header_of(together.path / POLICY)["plugins"] == ["my_study"]


@pytest.mark.slow
@pytest.mark.compiled
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core: one process")
def test_a_run_with_a_plugin_trains_compiled_in_two_processes(folder):
    words = [*WORDS, "compile=on", "evaluate=false", "out=compiled"]
    python(folder, "-m", "uavnav", "train", "ppo", *TRAIN[2:], *words)
    meta = Run(folder / "compiled").meta
    assert (meta["compiled"], meta["processes"], list(meta["plugins"])) == (True, 2, ["my_study"])


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("reinforce", "algorithm=reinforce; "),
        ("ppo activation=hs", "activation"),
        ("ppo", "out={}: contains a run with task=narrow; give another folder"),
    ],
)
def test_the_command_that_goes_on_with_a_run_says_which_plugin_it_needs(
    words, line, run, capsys, monkeypatch
):
    monkeypatch.setattr(plugins, "LOADED", {})
    monkeypatch.delitem(TASKS, "narrow", raising=False)
    monkeypatch.setattr(sys, "argv", ["uavnav"])
    try:
        status = commands.run("train", [*words.split(), f"out={run.path}"])
    except SystemExit as end:
        status = end.code
    err = capsys.readouterr().err
    assert (status, err.count("\n")) == (2, 1)
    assert err.startswith(f"uavnav train: {line.format(run.path)}")
    assert err.endswith("; it was made with plugins, give --plugins my_study (plugins= to uavnav train)\n")


# -- commands ------------------------------------------------------------------------------------------------

COMMANDS = {
    "evaluate": ["RUN", "--episodes", "3", "--max-steps", "20"],
    "verify": ["RUN", "--frames", "512"],
    "render": ["RUN", "--steps", "5", "--out", "episode.png"],
    "export": ["RUN", "--out", "policy.pt2"],
    "play": ["RUN"],
}


def refused(folder, path, plugin, capsys):
    """Each command answers a run in one line that names the plugin, imports nothing and leaves nothing."""
    before = sorted(folder.rglob("*"))
    for command, words in COMMANDS.items():
        assert commands.run(command, [str(path) if word == "RUN" else word for word in words]) == 2, command
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith(f"uavnav {command}: {path}/")
        assert f"it was made with plugins, give --plugins {plugin} (plugins= to uavnav train)" in err
        assert err.count("\n") == 1
        assert plugin not in sys.modules
    assert sorted(folder.rglob("*")) == before


def test_without_the_flag_every_command_says_in_one_line_which_to_give_and_imports_nothing(
    folder, run, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    refused(folder, run.path, "my_study", capsys)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_each_command_has_the_flag(command, capsys):
    with pytest.raises(SystemExit):
        commands.run(command, ["--help"])
    assert "--plugins NAME,..." in capsys.readouterr().out


FEWER = {"evaluate": ["--episodes", "3", "--max-steps", "20"], "render": ["--steps", "5"]}
UNDRAWN = """
from uavnav.__main__ import main
from uavnav.report import figures

figures.draw = lambda *anything: []
"""
NO_REPLAYS = f"uavnav report: left out: {RUN}: a page has no replays of task=narrow; uavnav render "
NO_REPLAYS += "makes a film of it\n"


def test_the_commands_of_the_docs_and_an_export_run_with_the_flag(folder, tmp_path):
    there = shutil.copytree(folder, tmp_path / "there")
    export = ["export", RUN, "--out", "policy.pt2", "--plugins", "my_study"]
    commands = [[*words, *FEWER.get(words[0], [])] for words in (*OTHERS, export)]
    lines = [f"assert main({words}) == 0, {words}" for words in commands]
    said = python(there, "-c", "\n".join([UNDRAWN, *lines]), err=NO_REPLAYS)
    assert "reinforce hardswish on 3 test layouts" in said
    assert len(Run(there / RUN).evaluation()) == 2 * 2 * 3
    assert f"{RUN}: the same, bit for bit: " in said
    assert (there / "episode.gif").is_file()
    assert "policy.pt2: observation [N, 30] -> values [N, 100]" in said
    assert "REINFORCE" in (there / "runs" / "report.md").read_text().upper()


def test_the_help_of_training_has_a_plugins_settings_and_activation(folder):
    told = python(folder, "-m", "uavnav", *TRAIN[:3], "--help")
    assert told.startswith("usage: uavnav train reinforce ")
    assert re.search(r"\n  activation=tanh .*, hardswish, ", told)
    assert re.search(r"\n  frames_per_batch=512 +\[frames per seed\] collected in an iteration", told)


def test_a_recipe_without_the_flag_refuses_a_plugins_names_like_any_other(folder, monkeypatch, capfd):
    monkeypatch.chdir(folder)
    command = [sys.executable, ROOT / "recipes" / "ppo.py", "activation=hardswish"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("uavnav train: activation=hardswish; choose from crelu, elu, ")
    assert result.stderr.count("\n") == 1


# -- nothing is imported that was not named ------------------------------------------------------------------


@pytest.fixture
def bomb(tmp_path, monkeypatch):
    """A folder with a module that leaves a mark when it is imported, and a run whose every file names it."""
    (tmp_path / "bomb.py").write_text(
        "from pathlib import Path\nPath(__file__).with_name('exploded').touch()\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = write_policies(tmp_path / "run", n_seeds=2)
    path = made / "config.yaml"
    path.write_text(
        yaml.safe_dump(yaml.safe_load(path.read_text()) | {"plugins": ["bomb"], "algorithm": "bomb"})
    )
    path = made / "meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"plugins": {"bomb": "0" * 64}}))
    path = made / POLICY
    header = header_of(path) | {"plugins": ["bomb"], "algorithm": "bomb", "module": "bomb"}
    save_file(load_file(path), path, metadata={"uavnav": json.dumps(header)})
    yield made
    assert not (tmp_path / "exploded").exists()
    assert "bomb" not in sys.modules


def test_files_of_a_run_that_name_a_plugin_have_it_never_imported(bomb, tmp_path, capsys):
    assert Run(bomb).algorithm == "bomb"
    with pytest.raises(
        PolicyError, match="unknown algorithm 'bomb'; it was made with plugins, give --plugins bomb"
    ):
        load_policy(bomb)
    refused(tmp_path, bomb, "bomb", capsys)


def test_the_file_of_a_studys_job_has_nothing_imported_either(bomb, monkeypatch):
    monkeypatch.setattr(worker.os, "dup2", lambda *streams: None)
    told = {
        "algorithm": "bomb",
        "kind": ["bomb", "Config"],
        "plugins": ["bomb"],
        "config": {},
        "evaluation": None,
    }
    told |= {"how": {}, "threads": 1}
    job = bomb.with_name("seeds.job")
    job.write_text(json.dumps(told | {"out": str(bomb), "folder": str(bomb.parent)}))
    worker.main(["uavnav.algorithms.ppo:PPOConfig", str(job)])
    assert "contains a run with algorithm=bomb" in json.loads(job.with_suffix(".ended").read_text())["error"]


def test_a_plugin_that_adds_nothing_a_run_needs_is_not_asked_for(bomb):
    path = bomb / POLICY
    save_file(load_file(path), path, metadata={"uavnav": json.dumps(header_of(path) | {"algorithm": "ppo"})})
    assert load_policy(bomb).algorithm == "ppo"
    (bomb / "meta.json").write_text('{"plugins"')
    with pytest.raises(PolicyError, match=r"meta\.json: "):
        load_policy(bomb)


# -- loading -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("raise ValueError('one\\ntwo')", "ValueError: one"),
        ("import nowhere_at_all", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("def (", "SyntaxError: "),
        ("import sys; sys.exit(0)", "SystemExit: 0"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_one_line_with_the_reason(code, reason, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "faulty.py").write_text(code)
    with pytest.raises(ConfigError) as refused:
        plugins.load(["faulty"])
    assert str(refused.value).startswith(f"plugins=faulty: cannot be imported ({reason}")
    assert "\n" not in str(refused.value)
    assert "faulty" not in plugins.LOADED


MINE = "from uavnav.algorithms import ALGORITHMS as A\nA['mine'] = A['ppo']._replace(module='{}')\n"
TAKES = {
    "the algorithm of another": (
        "",
        "from uavnav.algorithms import ALGORITHMS as A\nA['ppo'] = A['a2c']\n",
        "algorithm=ppo",
    ),
    "another plugin's": (MINE.format("first"), MINE.format("second"), "algorithm=mine"),
    "an activation": (
        "",
        "from uavnav import networks\nnetworks.ACTIVATIONS |= {'mine': abs, 'relu': abs}\n",
        "activation=relu",
    ),
}


@pytest.mark.parametrize("what", TAKES)
def test_a_plugin_that_gives_a_known_name_another_meaning_is_refused_and_the_name_keeps_its_own(
    what, tmp_path, monkeypatch
):
    *codes, taken = TAKES[what]
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "LOADED", {})
    names = [f"takes_{taken.replace('=', '_')}_{number}" for number in (1, 2)]
    for name, code in zip(names, codes, strict=True):
        (tmp_path / f"{name}.py").write_text(code)
    try:
        plugins.load(names[0])
        before = dict(ALGORITHMS), dict(uavnav.networks.ACTIVATIONS)
        for _ in range(2):  # the second time as the first
            with pytest.raises(
                ConfigError, match=f"^plugins={names[1]}: .*{taken} is there already; give yours"
            ):
                plugins.load(names[1])
        assert before == (dict(ALGORITHMS), dict(uavnav.networks.ACTIVATIONS))
        assert [*plugins.LOADED] == names[:1]
    finally:
        ALGORITHMS.pop("mine", None)


@pytest.mark.parametrize(
    ("reward", "says"),
    [
        (lambda step: step.distance.double(), "reward=odd: gives Tensor; give named terms"),
        (lambda step: {}, "reward=odd: gives dict; give named terms"),
        (
            lambda step: {"a": step.observation},
            r"reward=odd: its term a is of shape \[2, 30\]; give a tensor \[2\]",
        ),
        (lambda step: {"a": 1.0}, r"reward=odd: its term a is a float; give a tensor \[2\]"),
        (lambda step: {"a": step.nothing}, "'Step' object has no attribute 'nothing'"),
    ],
)
def test_a_reward_that_gives_no_terms_ends_in_one_line_before_anything_is_written(
    reward, says, tmp_path, monkeypatch
):
    monkeypatch.setitem(uavnav.rewards.REWARDS, "odd", reward)
    with pytest.raises(ConfigError, match=f"^task=drone with reward=odd: {says}"):
        ppo.train(ppo.PPOConfig(reward="odd", **SHORT), out=tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


class Other(ppo.PPO):
    """PPO that keeps its policy where nobody finds it, or one that is no MLP."""

    where, what = "pi", staticmethod(lambda policy: policy)

    def networks(self):
        return {self.where: self.what(self.policy)}


@pytest.mark.parametrize(
    ("where", "what", "says"),
    [
        ("pi", lambda policy: policy, "; it gives pi$"),
        ("policy", lambda policy: torch.nn.Sequential(policy), r" of hidden=\[8\]; its tensors are others$"),
    ],
)
def test_a_policy_that_could_not_be_read_again_is_refused_before_training(
    where, what, says, tmp_path, monkeypatch
):
    monkeypatch.setattr(Other, "where", where)
    monkeypatch.setattr(Other, "what", staticmethod(what))
    monkeypatch.setattr(ppo.PPOConfig, "make", lambda config, compile: Other(config, compile))
    line = "^algorithm=ppo: networks.. must give policy, made by uavnav.networks.mlp"
    with pytest.raises(ConfigError, match=line + says):
        ppo.train(ppo.PPOConfig(**SHORT), out=tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


def test_a_plugin_that_has_changed_since_is_told_of_also_by_the_command_that_finds_its_run_finished(folder):
    file = folder / "my_study.py"
    code = file.read_text()
    words = ["-m", "uavnav", *TRAIN[:2], f"+{TRAIN[2]}", *TRAIN[3:], *WORDS, "evaluate=false"]
    assert "this run is already finished" in python(folder, *words)
    try:
        file.write_text(f"{code}\n# another line\n")
        again = subprocess.run(
            [sys.executable, *words], cwd=folder, capture_output=True, text=True, check=True
        )
    finally:
        file.write_text(code)
    assert f"uavnav train: {RUN}: my_study is not what it was when this was trained\n" in again.stderr
    assert "this run is already finished" in again.stdout


def test_a_plugin_that_is_a_folder_is_another_one_once_any_of_its_files_changes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "LOADED", {})
    (tmp_path / "my_package").mkdir()
    seen = set()
    for code in ("", "one = 1\n", "one = 2\n"):
        (tmp_path / "my_package" / "__init__.py").touch()
        (tmp_path / "my_package" / "rewards.py").write_text(code)
        plugins.load("my_package")
        seen.add(plugins.LOADED.pop("my_package"))
    assert len(seen) == 3


def test_a_folder_that_cannot_be_imported_leaves_nothing_and_is_loaded_whole_once_it_is_mended(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "LOADED", {})
    (tmp_path / "half_package").mkdir()
    begin, bend = tmp_path / "half_package" / "__init__.py", tmp_path / "half_package" / "bends.py"
    bend.write_text("from uavnav import networks\nnetworks.ACTIVATIONS['half'] = abs\n")
    begin.write_text("from half_package import bends\n1 / 0\n")
    before = dict(uavnav.networks.ACTIVATIONS)
    with pytest.raises(ConfigError, match="cannot be imported"):
        plugins.load("half_package")
    assert before == uavnav.networks.ACTIVATIONS
    begin.write_text("from half_package import bends\n")
    importlib.invalidate_caches()
    plugins.load("half_package")
    try:
        assert {**before, "half": abs} == uavnav.networks.ACTIVATIONS
    finally:
        del uavnav.networks.ACTIVATIONS["half"], uavnav.networks.KNOWN["half"]


def test_a_module_that_is_not_there_is_one_line_and_no_names_are_no_import(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    before = list(sys.path)
    for none in ([], None):
        plugins.load(none)
    assert sys.path == before
    with pytest.raises(
        ConfigError, match=r"plugins=nowhere: is no module in .*; give a module's name, without \.py"
    ):
        plugins.load("nowhere")


def test_a_module_is_imported_once_and_what_it_adds_is_known_to_all_processes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "LOADED", {})
    for table in ("ACTIVATIONS", "KNOWN"):
        monkeypatch.setattr(uavnav.networks, table, dict(getattr(uavnav.networks, table)))
    tables = {"activation": (uavnav.networks.ACTIVATIONS, uavnav.networks.KNOWN)}
    monkeypatch.setattr(plugins, "TABLES", tables)
    code = "from uavnav import networks\nnetworks.ACTIVATIONS['twice'] = lambda x: 2 * x\nprint('imported')\n"
    (tmp_path / "adds_one.py").write_text(code)
    plugins.load("adds_one")
    plugins.load(["adds_one", "adds_one"])
    assert {"adds_one": hashlib.sha256(code.encode()).hexdigest()} == plugins.LOADED
    assert uavnav.networks.KNOWN["twice"] is uavnav.networks.ACTIVATIONS["twice"]
    assert " give --plugins other,more (" in plugins.missing(["adds_one", "other", "more"])
    assert plugins.missing({"adds_one": ""}) == ""
