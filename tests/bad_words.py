"""Settings, words of a command line and arguments that cannot be: one line with what would be right."""

import math

from bad_input import (
    EVALUATE,
    NUMBER,
    RENDER,
    VERIFY,
    WHOLE,
    argument,
    config,
    fly,
    gym_env,
    save_picture,
    word,
)

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.tasks.space import SpaceWorld

KNOWN = ", ".join(sorted(ALGORITHMS))
CASES = [
    # a configuration
    config({"activatoin": "relu"}, "did you mean activation?", "there is no key 'activatoin'"),
    config({"batch_size": 3}, "choose from", "there is no key 'batch_size'"),
    config({"epochs": 3}, "choose from", "there is no key 'epochs'", "dqn"),
    config({"preset": "papr"}, "did you mean paper?"),
    config({"activation": "rleu"}, "choose from elu, gelu"),
    config({"activation": 3}, "give a name"),
    config({"activation": None}, "give a name"),
    config({"layouts": 3}, "give a name"),
    config({"reward": "eq15"}, "choose from additive, eq14, goal, initial"),
    config({"world": {"slots": "first"}}, "choose from listed, nearest"),
    config({"world": {"padding": "ones"}}, "choose from far, zeros"),
    config({"world": {"start_heading": "down"}}, "choose from random, up"),
    config({"world": {"sensor_arc": 0}}, "above 0", "world.sensor_arc=0; "),
    config({"world": {"sensor_arc": 361}}, "at most 360", "world.sensor_arc=361; "),
    config({"world": {"sensor_arc": "wide"}}, NUMBER),
    config({"world": {"n_slots": 2.5}}, WHOLE),
    config({"world": {"border": 30}}, "must divide width=800", "world.border=30 "),
    config({"world": {"slotz": "nearest"}}, "did you mean world.slots?", "there is no key 'world.slotz'"),
    config({"world": 3}, "such as world.sensor_arc=90"),
    config({"task": "dron"}, "choose from drone, goal, moving, space, space-moving (did you mean drone?)"),
    config({"slots": "listed"}, "did you mean world.slots?", "there is no key 'slots'"),
    config({"init": "xavier"}, "choose from default, orthogonal"),
    config({"compile": "maybe"}, "choose from auto, off, on"),
    config({"loss": "l1"}, "choose from huber, squared", algorithm="dqn"),
    config({"device": "gpu"}, "choose cpu"),
    config({"device": "meta"}, "choose cpu"),
    config({"device": "cuda:99"}, "choose cpu"),
    config({"n_seeds": 0}, "at least 1"),
    config({"n_seeds": "two"}, WHOLE),
    config({"n_seeds": True}, WHOLE),
    config({"n_seeds": None}, WHOLE),
    config({"seed": -1}, "at least 0"),
    config({"seed": 1.5}, WHOLE),
    config({"seed": 2**31}, "at most 2147483647"),
    config({"total_frames": 0}, "at least 1"),
    config({"total_frames": 0.5}, WHOLE),
    config({"total_frames": math.inf}, WHOLE),
    config({"total_frames": math.nan}, WHOLE),
    config({"max_steps": 0}, "at least 1"),
    config({"max_steps": "never"}, WHOLE),
    config({"lr": -1.0}, "at least 0"),
    config({"lr": "fast"}, NUMBER),
    config({"lr": True}, NUMBER),
    config({"lr": math.nan}, NUMBER),
    config({"lr": math.inf}, NUMBER),
    config({"gamma": 1.1}, "at most 1"),
    config({"epsilon_end": 2.0}, "at most 1", algorithm="dqn"),
    config({"hidden": 64}, "such as [64,64]"),
    config({"hidden": []}, "at least one layer"),
    config({"hidden": [64, 0]}, "at least 1 unit"),
    config({"hidden": [64, "x"]}, WHOLE, "hidden=x; "),
    config({"hidden": [8.5]}, WHOLE, "hidden=8.5; "),
    config({"n_worlds": 7}, "give a divisor of frames_per_batch=2048"),
    config({"n_worlds": 6}, "give a multiple or a divisor of frames_per_update=4", algorithm="dqn"),
    config({"minibatch_size": 100}, "give a divisor of frames_per_batch=2048"),
    config({"minibatch_size": 1}, "at least 2"),
    config({"buffer_size": 8}, "give more than n_worlds=64", algorithm="dqn"),
    word("overwrite", "overwrite=2; ", "choose from false, true", "ppo", "overwrite=2"),
    word("evaluate", "evaluate=maybe; ", "choose from false, true", "dqn", "evaluate=maybe"),
    word("checkpoint_seconds", "checkpoint_seconds=-1; ", "at least 0", "ppo", "checkpoint_seconds=-1"),
    word("a plugin", "plugins=nowhere: is no module in ", "without .py", "ppo", "plugins=nowhere"),
    word("a plugin's file", "plugins=thesis.py: ", "without .py", "ppo", "plugins=thesis.py"),
    word("a plugin of a run", "--plugins nowhere: ", "without .py", *EVALUATE, "--plugins", "nowhere"),
    word("an algorithm", f"algorithm=poo; choose from {KNOWN}", "did you mean ppo?", "poo"),
    word("no algorithm", "algorithm=; ", f"choose from {KNOWN}", "activation=relu"),
    word("a key without a value", "'relu'", "", "ppo", "relu"),
    word("a sweep with one wrong", "activation=rleu; ", "did you mean relu?", "ppo", "-m", "activation=relu,rleu"),
    word(
        "a sweep into one folder", "out=new: two runs of the sweep", "leave it out", "ppo", "-m", "seed=1,2", "out=new"
    ),
    # arguments
    argument(
        "0 episodes", lambda f: fly(f, episodes=0), "episodes=0", "1 to 1000", "evaluate", "random", "--episodes=0"
    ),
    argument(
        "1001 episodes", lambda f: fly(f, episodes=1001), "=1001", "1 to 1000", "evaluate", "random", "--episodes=1001"
    ),
    argument(
        "0 steps", lambda f: fly(f, max_steps=0), "max_steps=0", "at least 1", "evaluate", "random", "--max-steps=0"
    ),
    argument("0 seeds of a script", None, "--seeds 0", "at least 1", "evaluate", "random", "--seeds=0"),
    argument("seeds of a rule", None, "--seeds 2", "only random has several", "evaluate", "reactive", "--seeds=2"),
    argument("a reward", lambda f: fly(f, reward="eq15"), "reward='eq15'", "choose from eq14"),
    argument("a slot order", lambda f: uavnav.World(slots="first"), "slots='first'", "choose from nearest, listed"),
    argument("a box's depth", lambda f: SpaceWorld(depth=280), "depth=280", "give above 280 px"),
    argument("a border", lambda f: uavnav.World(border=30), "border=30", "must divide"),
    argument("an activation", lambda f: uavnav.networks.Activation("rleu"), "activation='rleu'", "choose from elu"),
    argument("a cap", lambda f: uavnav.DroneEnv(max_steps=0), "max_steps=0", "a whole number from 1"),
    argument("a cap in half steps", lambda f: uavnav.DroneEnv(max_steps=1.5), "max_steps=1.5", "a whole number from 1"),
    argument("seeds", lambda f: uavnav.DroneEnv([3], seeds=[1, 2]), "2 seeds for batch_size [3]", "one per agent"),
    argument("a drone's action", lambda f: gym_env().step(100), "action=100", "from 0 to 99"),
    argument("a drone's layout", lambda f: gym_env(layout=1000), "layout=1000", "from 0 to 999"),
    argument("no drone", lambda f: uavnav.gym.DroneVectorEnv(0), "num_envs=0", "at least 1"),
    argument("a screen", lambda f: uavnav.gym.DroneGymEnv(render_mode="human"), "'human'", "choose None or rgb_array"),
    argument(
        "a picture's kind", lambda f: save_picture(f / "x.bmp"), "x.bmp", ".gif or .png", *RENDER, "--out", "x.bmp"
    ),
    argument(
        "a picture's folder",
        lambda f: save_picture(f / "no/x.png"),
        "no/x.png",
        "a path that can be written",
        *RENDER,
        "--out",
        "{}/no/x.png",
    ),
    word("a picture's set", "--layout 1000", "choose from 0 to 999", *RENDER, "--layout", "1000"),
    word("a picture's steps", "--steps", "at least 1", *RENDER, "--steps", "0"),
    word("a repeat's frames", "--frames 0", "at least 1", *VERIFY, "--frames", "0"),
]
