"""`uavnav playground`: which policies are on the page, and what is said of those that cannot be."""

import base64
import json

import numpy as np
import pytest
import torch
from runs_by_hand import write_policies

from uavnav import load_policy
from uavnav.__main__ import main
from uavnav.views.browser.playground import MOST, collect


def told(words, capsys):
    """Status, what was printed and what was complained of."""
    status = main(["playground", *map(str, words)])
    return status, *capsys.readouterr()


def on(page):
    """The policies that a page holds."""
    return json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])["policies"]


def test_a_page_holds_the_three_lowest_seeds_of_each_run_with_their_weights_as_they_are(tmp_path, capsys):
    write_policies(tmp_path / "runs" / "dqn" / "tanh", "dqn", seed=4, n_seeds=5)
    write_policies(tmp_path / "runs" / "ppo" / "tanh", seed=0, n_seeds=1)
    write_policies(tmp_path / "runs" / "deep" / "ppo" / "tanh", seed=0, n_seeds=1)
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
    assert (found[2]["sizes"], found[2]["epsilon"], found[2]["acts"]) == ([30, 8, 100], 0.2, "epsilon-greedy")
    assert {one["head"] for one in found} == {"direct"}


def test_runs_of_one_algorithm_and_activation_are_told_apart_by_their_folders(tmp_path):
    for name in ("a", "b"):
        write_policies(tmp_path / name, n_seeds=1)
    found, _ = collect([tmp_path / "a", tmp_path / "b", tmp_path / "a"])
    parts = tmp_path.parts[-2:]
    assert [one["key"] for one in found] == [
        "-".join([*parts, name, "ppo", "tanh", "0"]) for name in ("a", "b")
    ]
    assert found[1]["title"] == f"PPO tanh, seed 0 ({'/'.join(parts)}/b)"


def test_a_policy_of_another_world_is_left_out_in_a_line(tmp_path, capsys):
    write_policies(tmp_path / "here", n_seeds=1)
    write_policies(tmp_path / "there", n_seeds=1, world={"sensor_arc": 90.0})
    status, out, err = told([tmp_path, "--out", tmp_path / "page.html"], capsys)
    assert status == 0
    assert out.endswith(": policies: 1; open it in a browser\n")
    assert err.count("\n") == 1
    assert err.startswith(
        f"uavnav playground: left out: {tmp_path / 'there'}: trained in another world than the page's"
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
    found, left_out = collect([tmp_path])
    assert [one["key"].split("-")[-4] for one in found] == ["late", "moving"]
    assert found[1]["title"].startswith("PPO tanh, seed 0 with moving obstacles (")
    assert [line.split(": ", 1)[1] for line in left_out] == [
        "trained in another world than the page's, which has every default",
        "the page has no stack '4'; it has 1",
    ]


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda root: None, "there is no such folder; give a folder that holds runs"),
        (lambda root: root.mkdir(), "holds no run; give a folder that does"),
        (
            lambda root: write_policies(root / "run").joinpath("policy.safetensors").unlink(),
            "no policy that the page can fly",
        ),
        (
            lambda root: write_policies(root / "run").joinpath("policy.safetensors").write_bytes(b"no"),
            "not a readable policy",
        ),
        (lambda root: write_policies(root / "run", world={"slots": "listed"}), "trained in another world"),
        (
            lambda root: [write_policies(root / str(n), n_seeds=1) for n in range(MOST + 1)],
            f"a page holds at most {MOST}",
        ),
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
