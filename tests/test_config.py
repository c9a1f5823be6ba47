"""Configurations: what they mean, what presets set, and what is the same for every algorithm."""

import pickle
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.a2c import A2CConfig
from uavnav.algorithms.c51 import PRESETS as C51_PRESETS
from uavnav.algorithms.c51 import C51Config
from uavnav.algorithms.dqn import PRESETS as DQN_PRESETS
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PRESETS as PPO_PRESETS
from uavnav.algorithms.ppo import PPOConfig
from uavnav.algorithms.pqn import PQNConfig
from uavnav.algorithms.sac import SACConfig
from uavnav.cli.train import _sweep
from uavnav.errors import ConfigError
from uavnav.settings import AtLeast0, key, lines
from uavnav.tasks.world import World
from uavnav.training.config import TrainConfig, plain

SHARED = TrainConfig.model_fields


@pytest.mark.parametrize("kind", [one.config for one in ALGORITHMS.values()])
def test_each_algorithm_checks_what_all_share_as_one_does(kind):
    """How each of these is refused: `bad_input`."""
    for name, field in SHARED.items():
        own = kind.model_fields[name]
        assert (own.annotation, own.metadata) == (field.annotation, field.metadata), name
    with pytest.raises(ConfigError, match="give at least one layer, each of at least 1 unit"):
        kind(hidden=[])


def test_whole_floats_and_lists_become_what_they_mean():
    config = PPOConfig.from_mapping({"total_frames": 1e6, "hidden": [32, 32], "lr": 1, "compile": True})
    assert config.total_frames == 1_000_000
    assert isinstance(config.total_frames, int)
    assert config.hidden == (32, 32)
    assert isinstance(config.lr, float)
    assert config.compile == "on"


def test_seeds_are_counted_from_seed():
    assert PPOConfig(seed=5, n_seeds=3).seeds == [5, 6, 7]


SWITCHES = {"slots": "listed", "padding": "zeros", "start_heading": "random", "sensor_arc": 90}


def test_fields_of_the_world_reach_it_and_its_task_and_the_others_keep_their_defaults():
    config = DQNConfig(world=SWITCHES)
    assert config.world == config.make_task().world == World(**SWITCHES) != World()
    assert isinstance(config.world.sensor_arc, float)
    assert DQNConfig(world=World(**SWITCHES)) == config
    assert DQNConfig().world == DQNConfig(world={}).world == World()


def test_a_configuration_is_the_same_again_from_its_plain_settings_world_included():
    for config in (
        PPOConfig(world=SWITCHES, hidden=[8]),
        DQNConfig(preset="fast"),
        A2CConfig(max_steps=9),
        C51Config(v_min=-1),
        SACConfig(target_entropy=0.3),
        PQNConfig(preset="best"),
    ):
        settings = yaml.safe_load(yaml.safe_dump(plain(config)))
        assert type(config).from_mapping(settings) == config


def test_one_million_frames_are_run_in_whole_iterations():
    assert (PPOConfig().iterations, PPOConfig().frames) == (489, 1_001_472)
    assert (DQNConfig().iterations, DQNConfig().frames) == (250_000, 1_000_000)
    assert (A2CConfig().iterations, A2CConfig().frames) == (200_000, 1_000_000)


NETWORK = {"hidden": (64, 64), "total_frames": 10**6, "gamma": 0.99}
ON_POLICY = NETWORK | {"init": "orthogonal", "n_envs": 1, "critic_coeff": 0.5, "entropy_coeff": 0.0}
OFF_POLICY = NETWORK | {"init": "default", "n_envs": 1, "buffer_size": 10**6, "frames_per_update": 4}
OF_DQN = OFF_POLICY | {"batch_size": 32, "target_update_frames": 10_000}
PUBLISHED = {
    "SB3's PPO": (
        PPOConfig,
        ON_POLICY
        | {"lr": 3e-4, "adam_eps": 1e-5, "frames_per_batch": 2048, "minibatch_size": 64, "epochs": 10},
        {"gae_lambda": 0.95, "clip_epsilon": 0.2, "max_grad_norm": 0.5},
    ),
    "SB3's A2C": (
        A2CConfig,
        ON_POLICY | {"lr": 7e-4, "rms_eps": 1e-5, "n_steps": 5, "gae_lambda": 1.0, "max_grad_norm": 0.5},
        {"iterations": 200_000},
    ),
    "SB3's DQN": (
        DQNConfig,
        OF_DQN
        | {"lr": 1e-4, "adam_eps": 1e-8, "learning_starts": 50_000, "loss": "huber", "max_grad_norm": 10.0},
        {"epsilon_start": 1.0, "epsilon_end": 0.05, "exploration_fraction": 0.1},
    ),
    "the authors' C51": (
        C51Config,
        OF_DQN | {"n_atoms": 51, "lr": 2.5e-4, "adam_eps": 0.01 / 32, "epsilon_end": 0.01},
        {"double": False, "dueling": False, "n_steps": 1},
    ),
    "CleanRL's SAC with SB3's soft targets": (
        SACConfig,
        OFF_POLICY | {"lr": 3e-4, "adam_eps": 1e-4, "learning_starts": 20_000, "batch_size": 64},
        {"target_entropy": 0.89, "tau": 0.005, "max_grad_norm": None},
    ),
}
"""The numbers of the preset `paper`."""


@pytest.mark.parametrize(("kind", "numbers", "more"), PUBLISHED.values(), ids=PUBLISHED)
def test_the_default_preset_has_the_published_numbers(kind, numbers, more):
    numbers = numbers | more
    assert {name: getattr(kind(), name) for name in numbers} == numbers


def test_other_presets_differ_from_it_where_they_say():
    def those(preset, *names):
        return {name: getattr(preset, name) for name in names}

    newer, first = vars(DQN_PRESETS["vectorised-2.3"]), vars(DQN_PRESETS["vectorised"])
    assert {key: value for key, value in newer.items() if first[key] != value} == {
        "preset": "vectorised-2.3",
        "learning_starts": 100,
    }
    names = "double", "dueling", "n_steps", "lr"
    rainbow = those(C51_PRESETS["rainbow-lite"], *names)
    assert rainbow == {"double": True, "dueling": True, "n_steps": 5, "lr": 2.5e-4}
    fast = those(C51_PRESETS["fast"], *names, "gamma")
    assert fast == {"double": True, "dueling": False, "n_steps": 5, "lr": 2.5e-4, "gamma": 0.98}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_preset_bears_its_own_name_and_no_other_name_is_taken(name):
    kind, presets = ALGORITHMS[name].config, ALGORITHMS[name].presets
    assert {name: preset.preset for name, preset in presets.items()} == {name: name for name in presets}
    with pytest.raises(ConfigError, match="preset=quick; choose from"):
        kind(preset="quick")
    assert tuple(kind.PRESETS) == tuple(presets)


def test_a_preset_named_in_python_sets_its_values_and_a_given_one_goes_before():
    assert PPOConfig(preset="fast") == PPO_PRESETS["fast"]
    assert PPOConfig(preset="fast").n_envs == 128
    assert PPOConfig(preset="fast", n_envs=64).n_envs == 64
    assert DQNConfig(preset="vectorised-2.3").learning_starts == 100
    assert PPO_PRESETS["fast"].replace(lr=0.5).beyond_preset() == {"lr": 0.5}
    assert pickle.loads(pickle.dumps(PPO_PRESETS["fast"])) == PPO_PRESETS["fast"]


def test_what_a_run_changes_of_its_preset_is_named_but_for_what_every_table_says():
    changed = PPOConfig(lr=1e-3, hidden=[32], n_envs=32, activation="relu", seed=3)
    assert changed.beyond_preset() == {"lr": 1e-3, "hidden": [32]}
    elsewhere = PPOConfig(world={"sensor_arc": 90, "slots": "listed"}, reward="initial")
    assert elsewhere.beyond_preset() == {
        "reward": "initial",
        "world.sensor_arc": 90.0,
        "world.slots": "listed",
    }


def test_a_configuration_of_a_plugin_says_what_is_new_and_keeps_the_meaning_of_what_it_sets_anew():
    class Mine(PPOConfig):
        lr: AtLeast0 = key(0.5)
        gamma: float = 0.5
        horizon: int = 3

        def check(self):
            super().check()
            assert self.horizon < 9, "horizon is too far"

    said = {line.name: line for line in lines(Mine)}
    assert said["lr"][1:] == ("0.5", "", "Adam's learning rate; at least 0")
    assert (said["gamma"].default, said["gamma"].meaning) == ("0.5", "discount of a step")
    assert said["horizon"][1:] == ("3", "", "")
    assert Mine(horizon=4).horizon == 4
    with pytest.raises(ConfigError, match="horizon is too far"):
        Mine(horizon=9)
    with pytest.raises(ConfigError, match="horizon=far; give a whole number"):
        Mine(horizon="far")


def test_keys_with_a_dot_are_fields_of_a_part_beside_those_that_are_given_whole():
    config = PPOConfig.from_mapping({"world": {"n_slots": 5}, "world.sensor_arc": 90, "faults.late": 2})
    assert (config.world, config.faults.late) == (World(n_slots=5, sensor_arc=90), 2)
    with pytest.raises(ConfigError, match="world=flat; give fields of the world"):
        PPOConfig.from_mapping({"world": "flat", "world.sensor_arc": 90})
    with pytest.raises(
        ConfigError, match=r"there is no key 'world\.sensor_arc' with world=World; give one of them"
    ):
        PPOConfig.from_mapping({"world": World(), "world.sensor_arc": 90})


@pytest.mark.parametrize(
    ("words", "runs"),
    [
        (["lr=1e-3", "lr=.5"], [{"lr": 0.5}]),
        (["out='a,b'", "device=a=b", "seed="], [{"out": "a,b", "device": "a=b", "seed": ""}]),
        (
            ["+out=2024-01-01", "layer_norm=True", "max_steps=null"],
            [{"out": "2024-01-01", "layer_norm": True, "max_steps": None}],
        ),
        (
            ["logger=[tensorboard,wandb]", "world={n_slots: 5}"],
            [{"logger": ["tensorboard", "wandb"], "world": {"n_slots": 5}}],
        ),
        (["hidden=[64,64],[32]"], [{"hidden": [64, 64]}, {"hidden": [32]}]),
        (["seed=range(0,4,2)", "lr=1,2"], [{"seed": s, "lr": lr} for s in (0, 2) for lr in (1, 2)]),
    ],
)
def test_words_of_a_command_line_become_the_settings_of_each_run(words, runs):
    assert _sweep(words, multirun=True) == runs


def test_a_preset_of_a_plugin_alone_reads_its_run_again():
    class Mine(PPOConfig):
        PRESETS: ClassVar[dict[str, dict[str, Any]]] = {"mine": {"lr": 0.5}}
        preset: str = key("mine")

    there = Mine.as_run({"algorithm": "ppo", **plain(Mine(epochs=3))})
    assert Mine.from_mapping(there) == Mine(epochs=3)
    assert there["lr"] == 0.5


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_default_preset_is_the_papers_with_one_environment_and_vectorised_has_many(name):
    kind, many = ALGORITHMS[name].config, {"ppo": 16, "a2c": 16}.get(name, 64)
    assert (kind().preset, kind().n_envs) == ("paper", 1)
    assert kind(preset="vectorised") == kind(n_envs=many).replace(preset="vectorised")
    assert kind().folder == Path("runs") / f"{name}-paper" / "tanh"


def test_a_folder_of_digits_keeps_its_name():
    assert _sweep(["out=007", "seed=007"], False) == [{"out": "007", "seed": 7}]
    assert _sweep(["out=null"], False) == [{"out": None}]


def test_several_plugins_are_one_value():
    assert _sweep(["plugins=one,two", "seed=1"], False) == [{"plugins": "one,two", "seed": 1}]
