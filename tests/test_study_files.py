"""Study files: the configurations they stand for, those that are committed, and what is refused."""

import functools
import json
import re
import runpy
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from bad_input import a_folder, a_pipe, endless, itself, large, put

from uavnav import studies
from uavnav.algorithms import ALGORITHMS, ppo
from uavnav.cli import commands
from uavnav.cli import study as cli_study
from uavnav.cli.study import parse, scripted_evaluations, status
from uavnav.errors import ConfigError
from uavnav.evaluation import Protocol
from uavnav.runs import progress, read_settings, run_folders
from uavnav.studies import draws, search
from uavnav.studies.run import evaluated, unevaluated
from uavnav.tasks import ladders
from uavnav.tasks.layouts import judged_on
from uavnav.training.config import plain

main = functools.partial(commands.run, "study")

ROOT = Path(__file__).parent.parent
MINE = """
what: two rates
settings:
  activation: [tanh, relu]
  n_seeds: 2
  dqn: {learning_starts: 1000}
configurations:
  - {algorithm: [ppo, dqn], folder: "rate-{lr}", lr: [0.1, 0.2], hidden: [8, 8], world.slots: listed}
"""


def written(folder, text):
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


def test_lists_stand_for_a_configuration_each_in_all_combinations(tmp_path):
    found = studies.configurations(studies.read(written(tmp_path, MINE)), Path("out"))
    assert [str(configuration.out) for configuration in found] == [
        f"out/rate-{rate}/{algorithm}/{activation}"
        for algorithm in ("ppo", "dqn")
        for activation, rate in (("tanh", 0.1), ("tanh", 0.2), ("relu", 0.1), ("relu", 0.2))
    ]
    assert {configuration.config.hidden for configuration in found} == {(8, 8)}
    assert {configuration.config.world.slots for configuration in found} == {"listed"}
    assert [getattr(configuration.config, "learning_starts", None) for configuration in found] == [
        None
    ] * 4 + [1000] * 4
    assert found[0].evaluations == (Protocol("test", 200, 10_000),)


def test_seeds_and_frames_of_the_command_line_hold_for_every_configuration(tmp_path):
    found = studies.configurations(studies.read(written(tmp_path, MINE), 3, 5_000), tmp_path)
    assert {(configuration.config.n_seeds, configuration.config.total_frames) for configuration in found} == {
        (3, 5_000)
    }


def test_a_configuration_is_evaluated_on_the_test_layouts_of_its_rung_and_across_ladders_once_it_is_trained(
    tmp_path,
):
    mine = MINE.replace(
        "configurations:", "  evaluate: {episodes: 5, max_steps: 9, across: [density, arc]}\nconfigurations:"
    )
    mine = mine.replace("world.slots: listed", "layouts: density-4/train, faults.noise: 5")
    configuration = studies.configurations(studies.read(written(tmp_path, mine)), tmp_path)[0]
    assert configuration.evaluations == (Protocol("density-4/test", 5, 9),)
    assert configuration.config.faults.noise == 5
    bounds = ["--episodes", "5", "--max-steps", "9"]
    own = ["--layouts", "density-4/test", *bounds]
    assert unevaluated(configuration) == [own, [*bounds, "--alone", "--across", "density", "arc"]]
    put(configuration.out / "evaluation-density-4-test-5-9.parquet", "")
    put(configuration.out / "across-density-5-9.parquet", "")
    assert unevaluated(configuration) == [[*bounds, "--alone", "--across", "arc"]]
    put(configuration.out / "across-arc-5-9.parquet", "")
    assert evaluated(configuration)
    assert unevaluated(configuration._replace(evaluations=())) == []


@pytest.mark.parametrize(
    ("said", "flown"),
    [
        ("true", Protocol(episodes=200, max_steps=1000)),
        ("{episodes: 5}", Protocol(episodes=5, max_steps=1000)),
        ("{max_steps: 3000}", Protocol(episodes=200, max_steps=3000)),
    ],
)
def test_a_configuration_with_a_goal_is_evaluated_for_1000_steps_unless_its_study_says_another_limit(
    said, flown, tmp_path
):
    text = f"configurations: [{{algorithm: ppo, task: goal, evaluate: {said}}}]"
    (configuration,) = studies.configurations(studies.read(written(tmp_path, text)), tmp_path)
    assert configuration.evaluations == (flown,)
    (words,) = scripted_evaluations([configuration], tmp_path)
    assert words[words.index("--max-steps") + 1] == str(flown.max_steps)


def test_a_study_may_fly_under_the_shield_count_more_measures_and_name_its_scripted_policies(tmp_path):
    evaluate = "{episodes: 5, max_steps: 9, shield: [false, true], measures: true}"
    text = f"""
        settings: {{evaluate: {evaluate}}}
        scripted_folder: baselines
        scripted: [apf, orca]
        configurations:
          - {{algorithm: ppo, folder: drone}}
          - {{algorithm: ppo, folder: moving, task: moving, world.sense_velocity: true}}
    """
    study = studies.read(written(tmp_path, text))
    found = studies.configurations(study, tmp_path)
    bounds = ["--episodes", "5", "--max-steps", "9"]
    flown = ["--layouts", "test", *bounds]
    assert unevaluated(found[0]) == [[*flown, "--measures"], [*flown, "--shield", "--measures"]]
    put(found[0].out / "evaluation-test-5-9.parquet", "")
    put(found[0].out / "evaluation-test-5-9-shielded.parquet", "")
    assert evaluated(found[0])
    out = ["--out", str(tmp_path), "--measures"]
    moving = ["apf", "orca", *bounds, "--task", "moving"]  # orca needs velocities, and flies only there
    evaluations = [["apf", *bounds, *out], ["apf", *bounds, "--shield", *out], [*moving, *out]]
    assert scripted_evaluations(found, tmp_path, study.scripted) == [
        *evaluations,
        [*moving, "--shield", *out],
    ]


def test_a_study_whose_scripted_policies_could_not_be_evaluated_says_so_and_ends_with_1(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(cli_study, "Runner", lambda *_, **__: SimpleNamespace(works=[], run=list))
    text = "{scripted_folder: home, configurations: [{algorithm: ppo, folder: drone}]}"
    path = written(tmp_path, text)
    put(tmp_path / "out" / "home", "")  # a file, in which there is no room
    words = [str(path), f"out={tmp_path / 'out'}", "report=false"]
    assert main([*words, "--quiet"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.fullmatch(r"uavnav study: \d evaluations of scripted policies failed; .* repeats them", last)


def test_scripted_policies_that_cannot_fly_a_task_are_skipped_in_a_study(tmp_path):
    """The histogram of vfh is of a plane, and orca needs moving obstacles."""
    tasks = "goal", "space", "space-moving"
    text = "settings: {evaluate: {episodes: 5, max_steps: 9}}\nconfigurations:\n"
    text += "".join(f"  - {{algorithm: ppo, folder: {name}, task: {name}}}\n" for name in tasks)
    found = studies.configurations(studies.read(written(tmp_path, text)), tmp_path)
    asked = scripted_evaluations(found, tmp_path, ["vfh", "dwa", "orca"])
    flown = [words[: words.index("--episodes")] for words in asked]
    assert flown == [["vfh", "dwa"], ["dwa"], ["dwa", "orca"]]


def test_classics_fly_where_a_configuration_was_trained_and_only_the_usual_ones_climb_its_ladder(tmp_path):
    text = """
        settings: {evaluate: {episodes: 5, max_steps: 9, across: [density]}}
        configurations: [{algorithm: ppo, layouts: density-4/train}]
    """
    found = studies.configurations(studies.read(written(tmp_path, text)), tmp_path)
    asked = scripted_evaluations(found, tmp_path, ["reactive", "dwa"])
    assert sum("dwa" in words for words in asked) == 1
    assert asked[0][:4] == ["reactive", "dwa", "--layouts", "density-4/test"]
    assert len(asked) == len(ladders.LADDERS["density"].rungs)


@pytest.mark.parametrize(
    ("layouts", "test"),
    [
        ("train", "test"),
        ("slalom-80/train", "slalom-80/test"),
        ("my-data/train", "test"),
        ("runs/layouts/4/train.safetensors", "test"),
    ],
)
def test_the_test_layouts_of_a_layout_file_are_those_of_its_rung(layouts, test):
    assert judged_on(layouts) == test


def test_the_study_of_worlds_trains_five_algorithms_and_two_presets_of_two_in_each_world():
    found = studies.configurations(studies.read("worlds"), Path("out"))
    worlds = {(one.config.task, str(one.config.layouts), str(one.config.faults)) for one in found}
    assert len(found) == len(worlds) * 2 * (5 + 2) + 2 * 2  # and SAC in two
    assert {one.config.total_frames for one in found} == {500_000}
    assert {one.evaluations[0].max_steps for one in found if one.config.task == "goal"} == {1000}
    assert {one.across for one in found if one.config.layouts == "train" and one.config.task == "drone"} == {
        (),
        ("density", "slalom"),
    }
    tuned = {(one.config.algorithm, one.config.preset) for one in found if one.config.preset != "vectorised"}
    assert tuned == {("ppo", "fast"), ("dqn", "fast"), ("sac", "fast")}


@pytest.mark.parametrize("first", [0, 1])
def test_scripted_policies_count_more_measures_if_any_of_the_configurations_with_a_protocol_does(
    first, tmp_path
):
    several = [
        f"{{algorithm: ppo, folder: '{name}', evaluate: {{measures: {name}}}}}" for name in ("true", "false")
    ]
    text = f"configurations: [{several[first]}, {several[1 - first]}]"
    found = studies.configurations(studies.read(written(tmp_path, text)), tmp_path)
    (words,) = scripted_evaluations(found, tmp_path)
    assert words[-1] == "--measures"


def test_scripted_policies_fly_task_and_rung_of_a_study_once_as_its_configurations_unless_rows_are_there(
    tmp_path,
):
    configurations = studies.configurations(studies.read("worlds"), tmp_path)
    words = scripted_evaluations(configurations, tmp_path)
    rules, own = ["random", "straight", "reactive"], ["--seeds", "10", "--out", str(tmp_path)]
    # the ladders have 11 and 8 rungs; four and one of them are worlds of the study
    assert len(words) == 11 + 7 + 7
    assert [*rules, "--layouts", "slalom-70/test", "--max-steps", "2000", *own] in words
    assert [*rules, "--max-steps", "1000", "--task", "goal", *own] in words
    assert [*rules, "--max-steps", "2000", "--faults", "noise=5", *own] in words
    for rule in rules[1:]:
        put(tmp_path / f"{rule}-goal-test-200-1000.parquet", "")
    assert ["random", "--max-steps", "1000", "--task", "goal", *own] in scripted_evaluations(
        configurations, tmp_path
    )
    put(tmp_path / "random-goal-test-200-1000.parquet", "")
    assert len(scripted_evaluations(configurations, tmp_path)) == 24
    assert (
        scripted_evaluations(
            [configuration._replace(evaluations=()) for configuration in configurations], tmp_path
        )
        == []
    )


@pytest.mark.parametrize("name", studies.names())
def test_the_study_files_of_the_package_hold_three_configurations_or_more_and_none_shares_a_folder(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    found = studies.configurations(studies.read(name), Path("out"))
    assert len({configuration.out for configuration in found}) == len(found) >= 3


def test_every_committed_run_is_a_configuration_of_a_study_with_its_settings_and_facts_and_trains_again():
    """But for the path of a layout file, which the study makes. Facts: what goes beyond its preset."""
    results = ROOT / "results"
    named = [studies.read(name) for name in studies.names()]
    configurations = {
        configuration.out: configuration
        for study in named
        for configuration in studies.configurations(study, results)
    }
    for study in (study for study in named if study.tune):
        configurations |= {
            configuration.out: configuration for configuration in search.winners(search.plan(study, results))
        }
    drawing = draws.plan(studies.read("ambiguities"), results)
    configurations |= {one.out: one for one in drawing.screened() + drawing.nearest()}
    found, _ = run_folders(results)
    assert len(found) == len([*results.rglob("config.yaml")]) == 386
    for path in found:
        config = configurations[path].config
        there = config.as_run(read_settings(path / "config.yaml"))
        assert there | {"layouts": config.layouts} == plain(config), path
        beyond = type(config).from_mapping(there).beyond_preset()
        told = read_settings(path / "meta.json")["beyond_preset"]
        told, beyond = ({key.removeprefix("world."): one[key] for key in one} for one in (told, beyond))
        assert told == beyond, path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("configurations: 3", "is no study; give a list of `configurations`"),
        ("[", "cannot be read"),
        (
            "configurations: [{algorithm: ppo}]\nwaht: x",
            "there is no key 'waht'; did you mean what? choose from configurations, draw, obstacles, ",
        ),
        ("configurations: [{folder: x}]", "is no configuration; it needs at least an `algorithm`"),
        (
            "configurations: [{algorithm: pop}]",
            f"algorithm=pop; did you mean ppo? choose from {', '.join(sorted(ALGORITHMS))}",
        ),
        ("configurations: [{algorithm: ppo, lrr: 1}]", "there is no key 'lrr'"),
        (
            "configurations: [{algorithm: ppo, lr: [0.1, 0.2]}]",
            "two configurations share it; name in braces what they differ in",
        ),
        (
            "configurations: [{algorithm: ppo, folder: '{lr}'}]",
            "folder={lr}: names 'lr', which the configuration does not set",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {steps: 3}}]",
            "evaluate={'steps': 3}; give true, false, or some of",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {across: [arcs]}}]",
            "across=['arcs']; give a list of some of density",
        ),
        (
            "obstacles: many\nconfigurations: [{algorithm: ppo}]",
            "obstacles=many; give a list of numbers of obstacles, such as [4, 12]",
        ),
        ("settings: 3\nconfigurations: [{algorithm: ppo}]", "settings=3; give keys and values"),
        ("settings: {dqn: 3}\nconfigurations: [{algorithm: ppo}]", "dqn=3; give keys and values"),
        (
            "configurations: [{algorithm: [ppo, [dqn]]}]",
            "algorithm=['ppo', ['dqn']]; give a name, or a list of some",
        ),
        ("configurations: [{algorithm: []}]", "algorithm=[]; give a name, or a list of some"),
        (
            "configurations: [{algorithm: ppo, 3: 4}]",
            "settings={'algorithm': 'ppo', 3: 4}; give keys and values",
        ),
        ("configurations: [{algorithm: ppo, lr: []}]", "lr=[]; give at least one value"),
        ("configurations: [{algorithm: ppo, hidden: []}]", "hidden=[]; give at least one"),
        (
            "configurations: [{algorithm: ppo, folder: '{lr.foo}', lr: 0.1}]",
            "folder={lr.foo}: names 'lr.foo', which the configuration does",
        ),
        (
            "configurations: [{algorithm: ppo, folder: ../x}]",
            "folder=../x: leads out of the study's own; give one within",
        ),
        (
            "configurations: [{algorithm: ppo, layouts: '{foo}'}]",
            "layouts={foo}: names 'foo', which the configuration does not set",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {across: [3, [4]]}}]",
            "across=[3, [4]]; give a list of some of density",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {episodes: abc}}]",
            "evaluate.episodes=abc; give a whole number",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {max_steps: 0}}]",
            "evaluate.max_steps=0; give a number of at least 1",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {episodes: 1001}}]",
            "evaluate.episodes=1001; give at most 1000, the split",
        ),
        ("configurations: &a [{algorithm: ppo}]\nsettings: *a", "aliases are not taken"),
        ("[" * 500, "cannot be read (nested too deeply)"),
        ("[" * 100_000, "cannot be read (while increasing flow level exceeded maximum nesting depth"),
        (
            "configurations: [{algorithm: ppo, lr: 0x" + "f" * 99 + "}]",
            "a whole number has more than 64 bits",
        ),
        (
            "obstacles: [1000000000]\nconfigurations: [{algorithm: ppo}]",
            "obstacles=[1000000000]; give a list of numbers of obstacles",
        ),
        (
            "scripted: [vfh]\nconfigurations: [{algorithm: ppo}]",
            "scripted=['vfh']; name at least one, and give a scripted_folder too",
        ),
        (
            "scripted: []\nscripted_folder: home\nconfigurations: [{algorithm: ppo}]",
            "scripted=[]; name at least one, and give a scripted_folder too",
        ),
        (
            "scripted: [vfh, rrt]\nconfigurations: [{algorithm: ppo}]",
            "scripted=['vfh', 'rrt']; give a list of some of random, straight",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {shield: 3}}]",
            "evaluate.shield=3; choose from false, true",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {measures: [true, false]}}]",
            "evaluate.measures=[True, False]; choose from false, true",
        ),
        (
            "scripted_folder: ../x\nconfigurations: [{algorithm: ppo}]",
            "scripted_folder=../x; give a folder's name, such as baselines",
        ),
        (
            'scripted_folder: "a\\0b"\nconfigurations: [{algorithm: ppo}]',
            "scripted_folder=a\\x00b; give a folder's name, such as baselines",
        ),
        (
            "configurations: [{algorithm: ppo, folder: '{lr:999999999}', lr: 1}]",
            "it has more than names in braces",
        ),
        (
            "configurations: [{algorithm: ppo, folder: '{lr.__class__}', lr: 1}]",
            "names 'lr.__class__', which the configuration does",
        ),
        ("configurations: [{algorithm: ppo, folder: '{lr!r}', lr: 1}]", "it has more than names in braces"),
        ("configurations: [{algorithm: ppo, folder: '{', lr: 1}]", "folder={: cannot be filled in ("),
        ("configurations: [{algorithm: ppo, folder: /tmp}]", "folder=/tmp: leads out of the study's own"),
        ('configurations: [{algorithm: ppo, folder: "a\\0b"}]', "folder=a\\x00b: no folder has such a name"),
        (f"configurations: [{{algorithm: ppo, folder: {'x' * 256}}}]", "no folder has such a name"),
        (
            f"configurations: [{{algorithm: ppo, folder: '{'{seed}' * 1001}', seed: 1}}]",
            "it has more than 1,000 characters",
        ),
        (
            f"configurations: [{{algorithm: [{'ppo, ' * 10_001}]}}]",
            "configurations stand for more than 10,000 runs; give fewer values",
        ),
        (
            "configurations: [{algorithm: ppo, "
            + ", ".join(f"{key}: {[*range(100)]}" for key in ("lr", "gamma", "seed"))
            + "}]",
            "configurations stand for more than 10,000 runs; give fewer values",
        ),
        (
            f"configurations: [{{algorithm: ppo, evaluate: {{max_steps: {[*range(1, 201)]}}}}}]",
            "evaluate: 200 of each run; give at most 100",
        ),
        ("configurations: [{algorithm: ppo, evaluate: {layouts: 3}}]", "evaluate.layouts=3; give a name"),
        (
            "configurations: [{algorithm: ppo, evaluate: {max_steps: 9999999999}}]",
            "evaluate.max_steps=9999999999; give a number",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {layouts: density-99999999/test}}]",
            "give at most 20,000,000 obstacles",
        ),
        (
            "configurations: [{algorithm: ppo, keep_at: [0.5], evaluate: {at: [0.5, 0.4]}}]",
            "evaluate.at=0.4; give some of keep_at=[0.5], or null",
        ),
        (
            "configurations: [{algorithm: ppo, evaluate: {faults: [none, nois=3]}}]",
            "evaluate.faults=nois=3: there is no key 'nois'; did you mean noise?",
        ),
        (
            "draw: {draws: 3}\nconfigurations: [{algorithm: ppo}]",
            "draw: nearest=None; give it as uavnav/studies/ambiguities.yaml does",
        ),
        (
            "draw: {draws: 2, nearest: 1, screen: {algorithm: ppo}, choices: {gama: [1]}}\n"
            "configurations: [{algorithm: ppo}]",
            "draw: there is no key 'gama'; did you mean gamma?",
        ),
        (
            "draw: {draws: 2, nearest: 1, screen: {algorithm: dqn, dqn: 3}, choices: {gamma: [1]}}\n"
            "configurations: [{algorithm: ppo}]",
            "draw: dqn=3; give keys and values",
        ),
        (
            "draw: {draws: 2, nearest: 1, screen: {algorithm: [[dqn]]}, choices: {gamma: [1]}}\n"
            "configurations: [{algorithm: ppo}]",
            "draw: algorithm=[['dqn']]; give a name, or a list of some",
        ),
        (
            "scripted_folder: [random]\nconfigurations: [{algorithm: ppo}]",
            "scripted_folder=['random']; give a folder's name, such as baselines",
        ),
    ],
)
def test_a_wrong_study_file_is_refused_in_one_line_that_names_it(text, said, tmp_path, capsys):
    name = written(tmp_path, text)
    assert main([name, f"out={tmp_path / 'out'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith((f"uavnav study: {name}: ", "uavnav study: study mine: "))
    assert said in line


@pytest.mark.parametrize("spoil", [a_folder, a_pipe, endless, large, itself])
def test_what_is_no_study_file_is_refused_in_one_line_before_anything_is_written(spoil, tmp_path, capsys):
    name = written(tmp_path, MINE)
    spoil(Path(name))
    assert main([name, f"out={tmp_path / 'out'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"uavnav study: {name}: cannot be read (")
    assert [*tmp_path.iterdir()] == [Path(name)]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["papr"],
            "no such study; did you mean paper? choose from activations, algorithms, ",
        ),
        (["paper", "engine=cloud"], "engine=cloud; choose from local, ray, slurm"),
        (["paper", "sede=3"], "there is no key 'sede'; did you mean seeds? choose from"),
        (["paper", "seeds=many"], "seeds=many; give a whole number"),
        (["paper", "seeds"], "'seeds' is no setting; settings are key=value: engine=local"),
        (["paper", "partition=long"], "there is no key 'partition'"),
        (["paper", "--status", "partition=long"], "there is no key 'partition'"),
        (["paper", "--status", "jobs=0"], "jobs=0; give a number of at least 1"),
        (["paper", "--json"], "--json: only a --status is JSON; give both, or leave it out"),
        (["paper", "out="], "out=: give a value, or leave it out"),
        (
            ["paper", "engine=ray", "address=127.0.0.1:1"],
            "engine=ray: there is no Ray cluster at address=127.0.0.1:1",
        ),
        (["paper", "engine=slurm"], "engine=slurm: there is no sbatch on this machine"),
    ],
)
def test_a_wrong_setting_is_refused_before_any_work(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    if "engine=ray" in words:
        pytest.importorskip("ray")
    assert main(words) == 2
    assert said in capsys.readouterr().err
    assert not [*tmp_path.rglob("*.yaml")]


def test_an_engine_whose_package_is_missing_names_the_extra(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    for engine, package in (("ray", "ray"), ("slurm", "submitit")):
        monkeypatch.setitem(__import__("sys").modules, package, None)
        assert main(["paper", f"engine={engine}"]) == 2
        assert (
            f"engine={engine}: not installed; pip install 'uavnav[scale]' brings it"
            in capsys.readouterr().err
        )


def test_settings_are_dealt_to_the_study_and_to_its_engine():
    own, of_engine = parse(["engine=slurm", "seeds=8", "frames=20000", "partition=long", "report=false"])
    assert (own.seeds, own.frames, own.report, own.engine) == (8, 20_000, False, "slurm")
    assert of_engine == {"partition": "long"}


def test_the_status_says_what_is_finished_and_what_is_missing(capsys):
    assert main(["paper", f"out={ROOT / 'results'}", "--status", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in rows] == ["finished"] * 8
    assert main(["paper", "out=nowhere", "--status"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "8 missing"


@pytest.mark.parametrize("out", ["file", "file/below"])
@pytest.mark.parametrize("words", [["--status"], []])
def test_a_file_is_no_folder_of_a_study(out, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    put(tmp_path / "file", "mine")
    assert main(["paper", f"out={out}", *words]) == 2
    assert capsys.readouterr() == ("", f"uavnav study: out={out}: is a file; give a folder\n")
    assert (tmp_path / "file").read_text() == "mine"


NOW = '"at": 9e99'


@pytest.mark.parametrize(
    "said", ["", "{", "[]", "3", f"{{{NOW}}}", f'{{"frames": "1", "total": 1, "rate": 1, {NOW}}}']
)
def test_progress_that_cannot_be_read_counts_as_not_there(said, tmp_path):
    configuration = studies.configurations(studies.read("paper"), tmp_path)[0]
    put(
        configuration.out / "progress.json", f'{{"frames": 1, "total": 2, "rate": null, "at": {time.time()}}}'
    )
    assert status(configuration)["state"] == "under way"
    put(configuration.out / "progress.json", said)
    assert (progress(configuration.out), status(configuration)["state"]) == ({}, "stopped")


def test_every_study_has_a_target_of_make_and_a_name_on_the_page():
    (targets,) = re.findall(r"^\.PHONY: (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    page = (ROOT / "docs" / "studies.md").read_text()
    for name in studies.names():
        assert name in [*targets.split(), "paper"]
        assert f"`{name}`" in page


def test_makespans_of_known_jobs_and_the_table_of_the_page():
    makespan = runpy.run_path(str(ROOT / "docs" / "makespan.py"))
    assert makespan["makespan"]([3.0, 3.0, 2.0], 2) == 5.0
    assert makespan["makespan"]([1.0] * 8, 4) == 2.0
    (shown,) = re.findall(
        r"<!-- makespan -->\n(.*?)\n<!-- end -->", (ROOT / "docs" / "studies.md").read_text(), re.DOTALL
    )
    assert shown == makespan["table"](ROOT / "results")


@pytest.mark.parametrize("name", studies.names())
def test_a_study_names_every_preset_so_that_another_default_leaves_it_as_it_is(name):
    study = studies.read(name)
    every = [study.settings | entry for entry in study.configurations]
    every += [said[own] for said, own in ((study.tune, "settings"), (study.draw, "screen")) if said]
    assert all("preset" in one for one in every)


def test_a_configuration_of_which_a_setting_is_wrong_is_refused():
    with pytest.raises(ConfigError, match="n_seeds=0"):
        studies.configurations(studies.read("paper", seeds=0), Path("out"))


def test_a_finished_run_of_other_settings_does_not_count_as_a_configuration(tmp_path, capsys):
    config = {"hidden": [4], "total_frames": 64, "frames_per_batch": 64, "epochs": 1, "n_envs": 2}
    ppo.train(ppo.PPOConfig(**config), out=tmp_path / "out" / "ppo" / "tanh", quiet=True)
    configuration = {"algorithm": "ppo", "evaluate": False, **config, "hidden": [[4]]}
    name = written(tmp_path, yaml.safe_dump({"configurations": [configuration | {"lr": 0.5}]}))
    words = [name, f"out={tmp_path / 'out'}"]
    assert main([*words, "--status"]) == 0
    assert "contains a run with lr=0.0003, not 0.5; give another folder" in capsys.readouterr().out
    assert main([*words, "report=false"]) == 2
    assert "contains a run with lr=0.0003, not 0.5; give another folder" in capsys.readouterr().err
    written(tmp_path, yaml.safe_dump({"configurations": [configuration]}))
    assert main([*words, "report=false"]) == 0


def test_numbers_may_be_written_as_1e6(tmp_path):
    name = written(tmp_path, "settings: {total_frames: 1e4}\nconfigurations: [{algorithm: ppo, lr: 1e-3}]")
    (configuration,) = studies.configurations(studies.read(name), tmp_path)
    assert (configuration.config.total_frames, configuration.config.lr) == (10_000, 0.001)
    assert parse(["frames=1e7"])[0].frames == 10_000_000


@pytest.mark.parametrize("said", ["one,other", "one, other", "[one, other]"])
def test_the_plugins_of_a_study_are_loaded_however_they_are_listed(said, monkeypatch):
    loaded = []
    monkeypatch.setattr("uavnav.plugins.load", loaded.extend)
    parse([f"plugins={said}"])
    assert loaded == ["one", "other"]
