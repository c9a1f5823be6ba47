"""Policies of Stable-Baselines3 act here as they do there, and no zip is ever unpickled."""

import base64
import functools
import io
import json
import os
import pickle
import re
import zipfile
from pathlib import Path

import pytest
import torch
from torch import nn

import uavnav
from uavnav import PolicyError, evaluate_policy, load_policy
from uavnav.__main__ import main
from uavnav.cli import commands
from uavnav.envs.sb3 import DroneVecEnv
from uavnav.runs import policies
from uavnav.views import render

render_command = functools.partial(commands.run, "render")

SHORT = {"ppo": {"n_steps": 16, "batch_size": 64}, "dqn": {"learning_starts": 64, "buffer_size": 1000}}
MODELS = {
    "ppo": ("ppo", "tanh", nn.Tanh, None),
    "ppo, other sizes": ("ppo", "relu", nn.ReLU, {"pi": [32], "vf": [16, 8]}),
    "ppo, no hidden layer": ("ppo", "tanh", nn.Tanh, []),
    "dqn": ("dqn", "relu", nn.ReLU, None),
    "dqn, other sizes": ("dqn", "leaky_relu", nn.LeakyReLU, [48, 24, 16]),
}


@pytest.fixture(scope="module")
def env():
    return DroneVecEnv(num_envs=16, layouts="train", seed=0)


@pytest.fixture(scope="module", params=list(MODELS))
def saved(request, env, tmp_path_factory):
    """A trained model of theirs, our policy of its zip, the zip and the activation."""
    import stable_baselines3 as sb3

    algorithm, name, activation, sizes = MODELS[request.param]
    how = {"activation_fn": activation} | ({} if sizes is None else {"net_arch": sizes})
    model = {"ppo": sb3.PPO, "dqn": sb3.DQN}[algorithm](
        "MlpPolicy", env, policy_kwargs=how, seed=0, device="cpu", **SHORT[algorithm]
    )
    model.learn(512)
    path = tmp_path_factory.mktemp("sb3") / "model.zip"
    model.save(path)
    return model, load_policy(path), path, name  # whose settings say its activation


@pytest.fixture(scope="module")
def observations(env):
    """1,600 that a random flight sees, and 1,600 that nobody sees."""
    seen = [env.reset()]
    actions = torch.randint(100, (99, 16), generator=torch.Generator().manual_seed(0))
    seen += [env.step(action.numpy())[0] for action in actions]
    noise = torch.rand(1600, 30, generator=torch.Generator().manual_seed(1))
    return torch.cat([torch.as_tensor(row) for row in seen] + [noise])


def their_values(model, observations):
    with torch.no_grad():
        if hasattr(model, "q_net"):
            return model.q_net(observations)
        return model.policy.action_net(model.policy.mlp_extractor.forward_actor(observations))


def test_on_3200_observations_it_chooses_what_their_predict_does(saved, observations):
    model, policy, _, _ = saved
    theirs, _ = model.predict(observations.numpy(), deterministic=True)
    assert torch.equal(policy(observations), torch.as_tensor(theirs))
    assert len(set(theirs.tolist())) > 1


def test_its_values_are_theirs_in_any_batch_shape(saved, observations):
    model, policy, _, _ = saved
    torch.testing.assert_close(
        policy.values(observations), their_values(model, observations), rtol=1e-5, atol=1e-6
    )
    one = policy.values(observations[:6].reshape(2, 3, 30))
    torch.testing.assert_close(one.reshape(6, 100), policy.values(observations[:6]))
    assert policy.algorithm == ("dqn" if hasattr(model, "q_net") else "ppo")


def test_sampled_it_acts_as_theirs_in_training(saved, observations):
    model, _, path, name = saved
    policy = load_policy(path, greedy=False, activation=name)
    same = observations[:1].expand(20_000, 30)
    draws = policy(same, torch.Generator().manual_seed(0))
    shares = torch.bincount(draws, minlength=100) / len(draws)
    values = their_values(model, observations[:1])[0]
    if policy.algorithm == "ppo":
        expected = torch.softmax(values, -1)
    else:
        expected = torch.full((100,), 0.05 / 100)
        expected[values.argmax()] += 0.95
    assert ((shares - expected).abs() < 5 * (expected * (1 - expected) / len(draws)).sqrt() + 1e-9).all()


def test_its_episodes_are_those_of_their_own_model_as_a_callable(saved):
    model, policy, _, _ = saved

    def theirs(observation, generator):
        return torch.as_tensor(model.predict(observation.numpy(), deterministic=True)[0])

    mine, other = (evaluate_policy(one, episodes=20, max_steps=60) for one in (policy, theirs))
    assert mine.equals(other)
    assert evaluate_policy(
        load_policy(saved[2], greedy=False, activation=saved[3]), episodes=5, max_steps=60
    ).shape[0]


# -- zips that are none --------------------------------------------------------------------------------------


def weights(algorithm="ppo", inputs=30, outputs=100):
    """What a small model's policy.pth holds."""
    if algorithm == "dqn":
        layers = {"q_net.q_net.0": (8, inputs), "q_net.q_net.2": (outputs, 8)}
        layers |= {key.replace("q_net.", "q_net_target.", 1): shape for key, shape in layers.items()}
    else:
        layers = {"mlp_extractor.policy_net.0": (8, inputs), "mlp_extractor.value_net.0": (8, inputs)}
        layers |= {"action_net": (outputs, 8), "value_net": (1, 8)}
    generator = torch.Generator().manual_seed(0)
    found = {}
    for name, shape in layers.items():
        found |= {
            f"{name}.weight": torch.randn(shape, generator=generator),
            f"{name}.bias": torch.zeros(shape[0]),
        }
    return found


def pth(content, **how):
    buffer = io.BytesIO()
    torch.save(content, buffer, **how)
    return buffer.getvalue()


def zipped(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def changed(algorithm="ppo", **changes):
    """policy.pth with some tensors changed, by name with __ for dots; None takes one away."""
    found = weights(algorithm)
    for name, change in changes.items():
        key = name.replace("__", ".")
        value = change(found.pop(key, None))
        if value is not None:
            found[key] = value
    return pth(found)


def nothing(old):
    return None


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("a pickle was executed",)


def inner_bomb():
    """policy.pth, a zip itself, of which a few kilobytes unpack to 80 megabytes."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(io.BytesIO(pth(weights()))) as good,
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as bad,
    ):
        for member in good.infolist():
            bad.writestr(
                member.filename, bytes(80 * 2**20) if "data/0" in member.filename else good.read(member)
            )
    return buffer.getvalue()


NOT_READABLE = "not a readable zip of Stable-Baselines3"
CONVOLUTIONS = {"features_extractor.cnn.0.weight": torch.zeros(32, 1, 8, 8)}
REFUSED = {
    "no such file": (None, "no such file; give what model.save"),
    "no zip": (b"x" * 100, NOT_READABLE),
    "empty": (b"", NOT_READABLE),
    "a zip of something else": ({"thesis.txt": b"It was a dark night."}, NOT_READABLE),
    "its weights empty": ({"policy.pth": b""}, NOT_READABLE),
    "its weights a pickle": ({"policy.pth": pickle.dumps(Bomb())}, NOT_READABLE),
    "its weights more than tensors": (
        {"policy.pth": pth({"action_net.weight": Bomb()})},
        "more than tensors",
    ),
    "its weights in the old format": (
        {"policy.pth": pth(weights(), _use_new_zipfile_serialization=False)},
        NOT_READABLE,
    ),
    "its weights one tensor": ({"policy.pth": pth(torch.zeros(3))}, "not a table of float32 tensors"),
    "its weights in float64": (
        {"policy.pth": pth({key: value.double() for key, value in weights().items()})},
        "not a table of float32",
    ),
    "a tensor without numbers": (
        {"policy.pth": changed(action_net__bias=lambda old: old.to("meta"))},
        NOT_READABLE,
    ),
    "a sparse tensor": (
        {"policy.pth": changed(action_net__weight=torch.Tensor.to_sparse)},
        "not a table of float32",
    ),
    "80 MB of zeros": ({"policy.pth": bytes(80 * 2**20)}, "policy.pth has more than 67,108,864 bytes"),
    "80 MB of zeros within": ({"policy.pth": inner_bomb()}, "more than 67,108,864 bytes of weights"),
    "a tensor of a terabyte": (
        {"policy.pth": changed(action_net__weight=lambda old: torch.zeros(1, 1).expand(2**19, 2**19))},
        "more than 67,108,864 bytes of weights",
    ),
    "no layers": ({"policy.pth": pth({})}, "no MlpPolicy of PPO, A2C or DQN"),
    "SAC": (
        {"policy.pth": pth({"actor.mu.weight": torch.zeros(2, 8)})},
        "for its action_net.bias, action_net.weight",
    ),
    "CnnPolicy": (
        {"policy.pth": pth(weights() | CONVOLUTIONS)},
        "for its features_extractor.cnn.0.weight; give one",
    ),
    "a bias missing": (
        {"policy.pth": changed(action_net__bias=nothing)},
        "for its action_net.bias; give one",
    ),
    "layers that do not fit": (
        {"policy.pth": changed(action_net__weight=lambda old: old[:, :7])},
        "do not fit each",
    ),
    "a flat layer": ({"policy.pth": changed(action_net__weight=torch.flatten)}, "do not fit each other"),
    "a number for a layer": (
        {"policy.pth": changed(action_net__weight=lambda old: old[0, 0])},
        "do not fit each",
    ),
    "31 inputs": (
        {"policy.pth": pth(weights(inputs=31))},
        "sees 31 numbers and chooses from 100 actions, not 30",
    ),
    "20 actions": (
        {"policy.pth": pth(weights("dqn", outputs=20))},
        "sees 30 numbers and chooses from 20 actions",
    ),
    "nan": (
        {"policy.pth": changed("dqn", **{"q_net__q_net__2__bias": lambda old: old * torch.nan})},
        "is not finite",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_any_other_zip_is_refused_in_one_line_and_nothing_is_executed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content, message = REFUSED[name]
    path = tmp_path / "model.zip"
    if isinstance(content, dict):
        zipped(path, content)
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(PolicyError) as refused:
        load_policy(path, activation="tanh")
    assert str(refused.value).startswith(f"{path}: ")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "a pickle was executed").exists()


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_only_the_weights_of_a_zip_are_read(algorithm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    members = {
        "policy.pth": pth(weights(algorithm)),
        "data": pickle.dumps(Bomb()),
        "pytorch_variables.pth": b"x",
    }
    policy = load_policy(zipped(tmp_path / "model.zip", members), activation="relu")
    assert (policy.algorithm, policy.world, policy.reward) == (algorithm, uavnav.World(), "eq14")
    assert policy(torch.rand(5, 30)).shape == (5,)
    assert not (tmp_path / "a pickle was executed").exists()


def test_the_activation_is_asked_for_a_zip_and_only_for_a_zip(tmp_path):
    path = zipped(tmp_path / "model.zip", {"policy.pth": pth(weights())})
    with pytest.raises(
        PolicyError,
        match=r"it does not tell the activation; give activation=\.\.\., one of crelu, elu, .*tanh",
    ):
        load_policy(path)
    with pytest.raises(
        PolicyError, match=r"unknown activation 'Tanh'; did you mean tanh\? choose from crelu, elu, "
    ):
        load_policy(path, activation="Tanh")
    with pytest.raises(
        PolicyError, match="seed=3; a zip of Stable-Baselines3 contains one policy: give no seed"
    ):
        load_policy(path, seed=3, activation="tanh")
    with pytest.raises(PolicyError, match=r"activation=tanh; a run knows its own: give it only for a \.zip"):
        load_policy(tmp_path, activation="tanh")


KWARGS = {"activation_fn": "<class 'torch.nn.modules.activation.LeakyReLU'>"}
SAYS = {
    "an activation": (KWARGS, "a.module", "leaky_relu"),
    "a default": ({}, "stable_baselines3.common.policies", "tanh"),
    "a class of one's own": ({}, "my_module", None),
    "an activation of one's own": ({"activation_fn": "<class 'my_module.Bend'>"}, "a.module", None),
}


@pytest.mark.parametrize("name", SAYS)
def test_an_activation_in_plain_text_is_read_and_the_pickle_beside_it_is_not(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given, module, activation = SAYS[name]
    bomb = base64.b64encode(pickle.dumps(Bomb())).decode()
    said = {"policy_kwargs": {":serialized:": bomb, **given}, "policy_class": {"__module__": module}}
    path = zipped(tmp_path / "model.zip", {"policy.pth": pth(weights()), "data": json.dumps(said)})
    if activation is None:
        with pytest.raises(PolicyError, match="it does not tell the activation"):
            load_policy(path)
    else:
        assert load_policy(path).network[1].name == activation
        with pytest.raises(PolicyError, match=f"activation=elu; its own is {activation}: leave it out"):
            load_policy(path, activation="elu")
    assert not (tmp_path / "a pickle was executed").exists()


def test_beside_a_scripted_policy_in_another_world_a_zips_rows_are_of_its_own(tmp_path, capsys):
    path = zipped(tmp_path / "theirs.zip", {"policy.pth": pth(weights())})
    words = [
        "--task",
        "goal",
        "--activation",
        "tanh",
        "--layouts",
        "validation",
        "--episodes",
        "2",
        "--out",
    ]
    assert main(["evaluate", "reactive", str(path), *words, str(tmp_path), "--max-steps", "5"]) == 0
    files = ["reactive-goal-validation-2-5", "theirs-greedy-validation-2-5", "theirs-sampled-validation-2-5"]
    assert sorted(one.stem for one in tmp_path.glob("*.parquet")) == files
    assert "reactive on 2 validation layouts" in capsys.readouterr().out


def test_a_zip_is_drawn_with_its_activation_beside_a_script(tmp_path, capsys):
    path = zipped(tmp_path / "theirs.zip", {"policy.pth": pth(weights())})
    words = [str(path), "straight", "--activation", "tanh", "--steps", "5", "--out", str(tmp_path / "a.png")]
    assert render_command(words) == 0
    assert f"{tmp_path.name}/theirs.zip, sampled: 5 steps" in capsys.readouterr().out
    (pilot,) = render.load_pilots([str(path)], greedy=True, activation="relu")
    observation = torch.rand(5, 30)
    assert torch.equal(pilot.policy(observation), load_policy(path, activation="relu")(observation))


def test_a_zip_flies_in_the_playground_with_its_activation(tmp_path):
    path = zipped(tmp_path / "theirs.zip", {"policy.pth": pth(weights())})
    page = tmp_path / "page.html"
    assert commands.run("play", [str(path), "--activation", "tanh", "--out", str(page)]) == 0
    data = json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])
    (policy,) = data["policies"]
    assert data["scene"]["pilots"] == ["you", policy["key"], "nobody", "nobody"]
    assert (policy["activation"], policy["name"]) == ("tanh", "theirs.zip")
    layers = [
        layer for layer in load_policy(path, activation="tanh").network.children() if hasattr(layer, "bias")
    ]
    own = torch.cat([part.detach().flatten() for layer in layers for part in (layer.weight, layer.bias)])
    assert base64.b64decode(policy["weights"]) == own.numpy().tobytes()


def test_the_package_unpickles_nowhere():
    for path in Path(policies.__file__).parent.glob("*.py"):
        assert not re.search(r"pickle\.loads?\(|weights_only=False|torch\.jit", path.read_text()), path


def test_the_snippets_of_the_page_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parent.parent / "docs" / "bridges.md").read_text()
    names = {}
    for code in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL):
        exec(compile(code, "docs/bridges.md", "exec"), names)
    assert names["values"].shape == (7, 100)
