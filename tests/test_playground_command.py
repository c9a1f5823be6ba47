"""`uavnav play` and `uavnav playground`: who is on the page, what it opens with, and what is said of who
cannot be.
"""

import base64
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from runs_by_hand import write_policies

from uavnav import load_policy
from uavnav.__main__ import main
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.tasks import layouts
from uavnav.views.browser.playground import MOST, collect, runs_in


def told(words, capsys):
    """Status, what was printed and what was complained of."""
    status = main(["playground", *map(str, words)])
    return status, *capsys.readouterr()


def contents(page):
    """The data that a page holds."""
    return json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])


def on(page):
    return contents(page)["policies"]


def scene(page):
    return contents(page)["scene"]


def test_a_page_holds_the_three_lowest_seeds_of_each_run_with_their_weights_as_they_are(tmp_path, capsys):
    write_policies(tmp_path / "runs" / "dqn" / "tanh", "dqn", seed=4, n_seeds=5)
    write_policies(tmp_path / "runs" / "ppo" / "tanh", seed=0, n_seeds=1)
    status, out, err = told([tmp_path / "runs", "--out", tmp_path / "new" / "page.html"], capsys)
    assert (status, err) == (0, "")
    assert out == f"{tmp_path / 'new' / 'page.html'}: policies: 4; open it in a browser\n"
    found = on(tmp_path / "new" / "page.html")
    assert [one["key"] for one in found] == ["ppo-tanh-0", "dqn-tanh-4", "dqn-tanh-5", "dqn-tanh-6"]
    weights = np.frombuffer(base64.b64decode(found[2]["weights"]), "<f4")
    network = load_policy(tmp_path / "runs" / "dqn" / "tanh", 5).network
    assert torch.equal(
        torch.tensor(weights), torch.cat([one.detach().flatten() for one in network.parameters()])
    )
    assert (found[2]["epsilon"], found[2]["acts"]) == (0.2, "epsilon-greedy")
    assert found[2]["sizes"] == [[30, 8, 0], [8, 100, 0]]
    assert {one["head"] for one in found} == {"direct"}


def test_runs_of_one_algorithm_and_activation_are_told_apart_by_their_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "study/b=1 x"):
        write_policies(tmp_path / name, n_seeds=1)
    found = collect(["a", "study/b=1 x", "a"]).policies
    assert [one["key"] for one in found] == ["a-ppo-tanh-0", "study-b=1-x-ppo-tanh-0"]
    assert (found[1]["title"], found[1]["name"]) == ("PPO tanh, seed 0 (study/b=1 x)", "b=1 x")
    for name in ("a/b", "a-b"):  # one name in a link
        write_policies(tmp_path / name, n_seeds=1)
    both = collect(["a/b", "a-b"])
    assert both.named == [one["key"] for one in both.policies] == ["a-b-ppo-tanh-0", "a-b-ppo-tanh-0_"]


def test_a_policy_of_another_world_or_in_3d_is_left_out_in_a_line_and_refused_where_it_is_named(
    tmp_path, capsys
):
    write_policies(tmp_path / "here", n_seeds=1)
    write_policies(tmp_path / "there", n_seeds=1, world={"sensor_arc": 90.0})
    status, out, err = told([tmp_path, "--out", tmp_path / "page.html"], capsys)
    assert status == 0
    assert out.endswith(": policies: 1; open it in a browser\n")
    watch = f"watch it: uavnav render {tmp_path / 'there'} --out episode.gif"
    why = "trained in another task than the playground's"
    line = f"{tmp_path / 'there'}: {why}; {watch}\n"
    assert err == f"uavnav playground: left out: {line}"
    assert main(["play", str(tmp_path / "there")]) == 2
    assert capsys.readouterr() == ("", f"uavnav play: {line}")
    assert main(["play", "--task", "space"]) == 2
    assert capsys.readouterr().err == (
        "uavnav play: --task space: the playground has no such task; "
        "watch it: uavnav render reactive --task space --out episode.gif\n"
    )


def test_policies_trained_with_faults_or_in_other_worlds_of_two_dimensions_are_on_the_page_and_stacks_are_not(
    tmp_path,
):
    write_policies(tmp_path / "late", n_seeds=1, faults={"late": 2})
    write_policies(tmp_path / "moving", n_seeds=1, task="moving", world={"speed_max": 4.0})
    write_policies(
        tmp_path / "sensing", n_seeds=1, n_inputs=50, task="moving", world={"sense_velocity": True}
    )
    write_policies(tmp_path / "stacked", n_seeds=1, n_inputs=120, stack=4)
    found, *_, left_out = collect([tmp_path])
    assert [one["key"].split("-")[-4] for one in found] == ["late", "moving"]
    assert found[1]["title"].startswith("PPO tanh, seed 0 with moving obstacles (")
    assert [line.split(": ", 1)[1].split("; watch it")[0] for line in left_out] == [
        "trained in another task than the playground's",
        "the playground has no stack '4'; it has 1",
    ]


def test_play_opens_ones_own_runs_if_there_are_some_and_the_browser_if_it_can(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    addresses = []
    monkeypatch.setattr("webbrowser.open", lambda address: addresses.append(address) or True)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    assert main(["play"]) == 0  # without runs, and without a screen: policies that ship
    path = Path(capsys.readouterr().out.split(": ")[0])
    _, ppo, dqn, script = scene(path)["pilots"]
    assert (ppo.split("-")[0], dqn.split("-")[0], script) == ("ppo", "dqn", "reactive")
    assert not path.is_relative_to(tmp_path)
    assert main(["play", "reactive", "--out", "page.html"]) == 0
    assert scene(Path("page.html"))["pilots"] == ["you", "reactive", "nobody", "nobody"]
    for name in ("one", "two"):
        write_policies(tmp_path / "runs" / "ppo" / name, n_seeds=1)
    capsys.readouterr()
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["play", "--layout", "150", "--max-steps", "50"]) == 0
    assert capsys.readouterr() == ("runs/playground.html: policies: 2; it opens in your browser\n", "")
    assert addresses == [(tmp_path / "runs/playground.html").as_uri()]
    assert scene(Path("runs/playground.html"))["pilots"] == [
        "you", "runs-ppo-one-ppo-tanh-0", "runs-ppo-two-ppo-tanh-0", "reactive",
    ]  # fmt: skip
    data = contents(Path("runs/playground.html"))
    assert (data["scene"]["layout"], data["tasks"]["drone"]["max_steps"]) == (150, 50)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html", "runs"]


def test_a_rung_and_a_layout_file_are_on_the_page_under_their_names(tmp_path, capsys):
    drawn = layouts.generate(3, k=5, seed=2)
    layouts.save(drawn, tmp_path / "my own.safetensors", seed=2, split="own")
    for word, name, shape in (
        (tmp_path / "my own.safetensors", "my-own", [3, 5, 3]),
        ("density-12/test", "density-12/test", [200, 12, 3]),
    ):
        out = str(tmp_path / "page.html")
        assert main(["play", "reactive", "--layouts", str(word), "--layout", "2", "--out", out]) == 0
        data = contents(Path(out))
        assert data["scene"]["layouts"] == name
        packed = [base64.b64decode(one["circles"]) for one in data["layouts"]["drone"][name]]
        assert [len(packed), len(packed[0]) / 12, data["layouts"]["drone"][name][0]["columns"]] == shape
    assert list(data["layouts"]["drone"]) == ["test", "validation", "train", "density-12/test"]


FLOWN = f"{','.join(EPISODE_COLUMNS)}\n0,30,7,7,30,0,0,0,40,-10.5,True,False\n"  # an episode of the page


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda text: text.replace("steps", "paces"), "cannot be read (its columns are others)"),
        (lambda text: text.replace(",7,7,", ",7,1000,"), "line 2 is no episode"),
        (lambda text: text.replace("True,False", "True,True"), "line 2 is no episode"),
        (lambda text: text.replace("30,0,0,0,40", "30,31,0,0,40"), "line 2 is no episode"),
        (lambda text: text.replace("30,0,0,0,40", "30,0,0,31,40"), "line 2 is no episode"),
        (lambda text: text.replace("30,0,0,0,40", "30,5,6,0,40"), "line 2 is no episode"),
        (lambda text: text.replace("30,0,0,0,40", "30,0,0,0,271"), "line 2 is no episode"),
        (lambda text: text.replace("-10.5", "much"), "cannot be read"),
        (lambda text: text.replace("30,0,0,0,40", "30,0,0,0,40.5"), "cannot be read"),
    ],
)
def test_a_file_to_keep_that_is_none_of_the_pages_is_one_line_and_nothing_is_kept(
    change, line, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "human.csv"
    path.write_text(change(FLOWN))
    assert main(["play", "--keep", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"uavnav play: {path}: {line}")
    assert "give human.csv, which K of the playground saves" in err
    assert not (tmp_path / "runs").exists()
    path.write_text(FLOWN)
    assert main(["play", "--keep", str(path)]) == 0


def test_two_flights_alike_are_two_and_a_file_that_is_kept_again_adds_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    head, line = FLOWN.splitlines()
    for flights, said in ((1, "1 episodes, 1 of"), (3, "3 episodes, 2 of"), (3, "3 episodes, 0 of")):
        Path("human.csv").write_text("\n".join([head, *[line] * flights]))
        assert main(["play", "--keep", "human.csv"]) == 0
        assert f": {said} them new" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda root: None, "no policy.safetensors there; give the folder of a finished run"),
        (lambda root: root.mkdir(), "contains no run; give a folder that does"),
        (
            lambda root: write_policies(root / "run").joinpath("policy.safetensors").unlink(),
            "no policy there; give a finished run's folder",
        ),
        (
            lambda root: write_policies(root / "run").joinpath("policy.safetensors").write_bytes(b"no"),
            "not a readable policy",
        ),
        (lambda root: write_policies(root / "run", world={"slots": "listed"}), "trained in another task"),
    ],
)
def test_what_is_no_folder_of_policies_is_one_line_and_no_page(make, line, tmp_path, capsys):
    make(tmp_path / "runs")
    status, out, err = told([tmp_path / "runs", "--out", tmp_path / "page.html"], capsys)
    assert (status, out) == (2, "")
    assert err.startswith("uavnav playground: ")
    assert line in err
    assert err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def test_of_very_many_runs_the_newest_are_on_the_page(tmp_path):
    for age in range(MOST + 2):
        write_policies(tmp_path / f"{age:02}", n_seeds=1)
        os.utime(tmp_path / f"{age:02}" / "policy.safetensors", (1e9 - age, 1e9 - age))
    assert [path.name for path in runs_in(tmp_path)] == [f"{age:02}" for age in range(MOST)]
    write_policies(tmp_path / "other" / "newest", n_seeds=1)
    both = [
        path.name for path in runs_in(*(tmp_path / f"{age:02}" for age in range(MOST)), tmp_path / "other")
    ]
    assert both == [*(f"{age:02}" for age in range(MOST - 1)), "newest"]
