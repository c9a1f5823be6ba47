"""Banks and policies that are damaged, doctored or not there: one line, and nothing changes."""

import math
import shutil
from pathlib import Path

import gymnasium
import pytest
import torch
from bad_input import (
    ANEW,
    DRONE,
    EVALUATE,
    FILE,
    FOLDER,
    GOOD_BANK,
    HEADER,
    LONG,
    NEW_BANK,
    READABLE,
    RENDER,
    SHAPE,
    bank,
    bank_for,
    by_name,
    evaluate,
    fly,
    in_the_library,
    make_good,
    on_the_command_line,
    policy,
    save_bank,
    train_ppo,
    word,
)
from spoiling import (
    a_folder,
    consistent,
    cut,
    entry,
    facts,
    flipped,
    header,
    itself,
    missing,
    nothing,
    obstacles,
    pickled,
    put,
    tensor,
    tensors,
    to_nan,
    torch_saved,
    widened,
    written,
)

import uavnav
from uavnav.tasks import layouts

RECIPES = Path(__file__).parent.parent / "recipes"

CASES = [
    # a bank that is read
    bank("missing", missing, "{}/bank", FILE),
    bank("a folder", a_folder, "{}/bank", FILE),
    bank("below a file", nothing, "{}/policy/bank", FILE, part="policy/bank"),
    bank("a link to itself", itself, "{}/bank", FILE),
    bank("empty", written(b""), READABLE),
    bank("cut in the data", cut(0.9), READABLE),
    bank("cut in the header", cut(0.05), READABLE),
    bank("five bytes", written(b"\x08\0\0\0\0"), READABLE),
    bank("a header of 2^60 bytes", written(b"\0" * 7 + b"\x10" + b"x" * 90), READABLE),
    bank("longer than it says", lambda path: put(path, path.read_bytes() + b"more"), READABLE),
    bank("a table of text", written("x,y,radius\n1,2,30\n" * 9), READABLE),
    bank("a pickle", pickled, READABLE),
    bank("a file of torch.save", torch_saved, READABLE),
    bank("a flipped bit in the header", flipped(8), READABLE),
    bank("a flipped bit in the data", flipped(-4), "{}/bank: the checksum does not match", ANEW),
    bank("no header", header(None), "{}/bank: made for world version None", ANEW),
    bank("another world version", obstacles(world_version="0"), "version 0, this is 1", ANEW),
    bank("no checksum", obstacles(sha256=""), "{}/bank: the checksum does not match", ANEW),
    bank("another n in the header", obstacles(n="21"), "{}/bank: its header says n=21, k=4,", "not n=20, k=4"),
    bank("no k in the header", obstacles(k=""), "{}/bank: its header says n=20, k=,", "not n=20, k=4"),
    bank("other tensors", tensors(lambda kept: kept.update(a=kept.pop("obstacles"))), "no tensor `obstacles`"),
    bank("float64", obstacles(lambda b: b.double()), "not float64", "{}/bank: a bank holds float32"),
    bank("whole numbers", obstacles(lambda b: b.long()), "not int64", "{}/bank: a bank holds float32"),
    bank("two axes", obstacles(lambda b: b[0]), "not [4, 3]", SHAPE),
    bank("two columns", obstacles(lambda b: b[..., :2]), "not [20, 4, 2]", SHAPE),
    bank("no sets", obstacles(lambda b: b[:0]), "not [0, 4, 3]", SHAPE),
    bank("nan", obstacles(entry(2, 0, math.nan)), "{}/bank: obstacle 2 of set 1 is not finite", ANEW),
    bank("an infinite radius", obstacles(entry(0, 2, math.inf)), "obstacle 0 of set 1 is not finite", ANEW),
    bank("a radius of 29.9", obstacles(entry(3, 2, 29.9)), "obstacle 3 of set 1 has a radius", "30 ... 100 px"),
    bank("a radius of 101", obstacles(entry(3, 2, 101.0)), "obstacle 3 of set 1 has a radius", "30 ... 100 px"),
    bank("on the start", obstacles(entry(0, slice(2), 400.0)), "obstacle 0 of set 1", "nearer than 50 px to the start"),
    bank("doctored with its checksum", consistent, "{}/bank: is not what seed 0 generates", ANEW),
    bank("a seed in words", obstacles(generator_seed="seven"), "{}/bank: is not what seed seven generates", ANEW),
    bank_for(
        "a run",
        lambda f: train_ppo(f, "new", layouts=str(f / "bank")),
        READABLE,
        GOOD_BANK,
        ["ppo", "layouts={}/bank", "out={}/new"],
        cut(0.9),
    ),
    bank_for("an environment", lambda f: uavnav.DroneEnv([2], f / "bank"), "checksum", ANEW, spoil=flipped(-4)),
    bank_for("Gymnasium", lambda f: gymnasium.make(DRONE, layouts=f / "bank"), READABLE, GOOD_BANK, spoil=cut(0)),
    bank_for("an evaluation", lambda f: evaluate(f, layouts="tset"), "'tset'", FILE, [*EVALUATE, "--layouts", "tset"]),
    bank_for("a baseline", lambda f: fly(f, layouts="x" * 300), "xxx", FILE, ["evaluate", "random", "--layouts", LONG]),
    bank_for("a picture", lambda f: layouts.load("tset"), "'tset'", FILE, [*RENDER, "--layouts", "tset"]),
    # a bank that is made
    bank_for("-1 sets", lambda f: layouts.generate(-1), "n=-1", "at least 0", [*NEW_BANK, "--n", "-1"]),
    bank_for("-1 obstacles", lambda f: layouts.generate(1, -1), "k=-1", "at least 0", [*NEW_BANK, "--k", "-1"]),
    bank_for(
        "seed -1",
        lambda f: layouts.generate(1, 1, -1),
        "seed=-1",
        "at least 0",
        [*NEW_BANK, "--seed=-1", "--split=test"],
    ),
    bank_for("no set", lambda f: save_bank(f / "new", 0), "not [0, 8, 3]", "n > 0", [*NEW_BANK, "--n", "0"]),
    bank_for(
        "a folder below a file",
        lambda f: save_bank(f / "policy" / "x"),
        "{}/policy/",
        FOLDER,
        ["layouts", "--out={}/policy", "--n=1"],
    ),
    bank_for(
        "in /proc", lambda f: save_bank("/proc/no/x"), "/proc/no/", FOLDER, ["layouts", "--out=/proc/no", "--n=1"]
    ),
    bank_for("onto a folder", lambda f: save_bank(f / "thesis"), "{}/thesis: cannot be written", FOLDER),
    word("one seed for both banks", "--seed 3", "give --split", *NEW_BANK, "--seed", "3"),
    # a policy
    policy("missing", missing, "no policy.safetensors there", "give the folder of a finished run"),
    policy("of a folder without", nothing, "no policy.safetensors there", "give the folder", part="thesis"),
    policy("of a half-finished run", nothing, "no policy.safetensors there", "give the folder", part="half"),
    policy("empty", written(b"")),
    policy("cut in the data", cut(0.9)),
    policy("cut in the header", cut(0.02)),
    policy("a pickle", pickled),
    policy("a file of torch.save", torch_saved),
    policy("a bank", lambda path: put(path, path.with_name("bank").read_bytes())),
    policy("no header", header(None)),
    policy("a header that is not JSON", header("{")),
    policy("a header that is a list", header("[1]")),
    policy("no seeds in the header", facts(seeds=...)),
    policy("seeds a number", facts(seeds=4)),
    policy("seeds words", facts(seeds="01")),
    policy("no seed", facts(seeds=[]), "holds no seed"),
    policy("a seed too many", facts(seeds=[0, 1, 2]), HEADER),
    policy("hidden a number", facts(hidden=8)),
    policy("hidden words", facts(hidden="8"), HEADER),
    policy("hidden a fraction", facts(hidden=[8.5]), HEADER),
    policy("hidden negative", facts(hidden=[-8]), HEADER),
    policy("another hidden", facts(hidden=[9]), HEADER),
    policy("too many layers", facts(hidden=[8, 8]), HEADER),
    policy("activation a list", facts(activation=["relu"]), "unknown activation ['relu']", "choose from elu, gelu"),
    policy("an unknown activation", facts(activation="rleu"), "unknown activation 'rleu'", "choose from elu, gelu"),
    policy("an unknown algorithm", facts(algorithm="sac"), "unknown algorithm 'sac'", "choose from a2c, dqn, ppo"),
    policy("an unknown reward", facts(reward="eq15"), "unknown reward 'eq15'", "choose from additive, eq14, initial"),
    policy("epsilon a word", facts(epsilon="small")),
    policy("an unknown switch", facts(world={"gravity": 9.81})),
    policy("an unknown task", facts(task="dron"), "unknown task 'dron'", "choose from drone (did you mean drone?)"),
    policy("an unknown way to act", facts(acts="beta"), "unknown way to act 'beta'", "choose from categorical"),
    policy("an unknown head", facts(head="c51"), "unknown head 'c51'", "choose from direct"),
    policy("a plugin's reward", facts(reward="mine", plugins=["my"]), "unknown reward 'mine'", "give --plugins my "),
    policy("plugins a number", facts(plugins=3)),
    policy("a world that is a list", facts(world=[90])),
    policy("a cap of 0", facts(max_steps=0), "not a readable policy file (max_steps=0"),
    policy("a cap in words", facts(max_steps="never"), "not a readable policy file (max_steps=never"),
    policy("a wrong switch", facts(world={"slots": "first"}), "not a readable policy file (slots='first'"),
    policy("another world version", facts(world_version="0"), "trained in world version 0", "this is 1"),
    policy("a tensor missing", tensor("policy.0.bias", lambda t: None), HEADER),
    policy("a tensor cut", tensor("policy.2.weight", lambda t: t[:, :7]), HEADER),
    policy("a tensor flat", tensor("policy.0.weight", torch.flatten), HEADER),
    policy("31 inputs", tensor("policy.0.weight", widened), "sees 31 numbers", "not 30 and 100"),
    policy("nan", tensor("policy.2.weight", to_nan), "policy.2.weight of seed 0 is not finite", "lower lr"),
    policy("another seed", nothing, "seed=7 is not there", "choose from 0 ... 1", seed=7),
]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return make_good(tmp_path_factory.mktemp("bad input") / "good")


@pytest.fixture
def folder(good, tmp_path, monkeypatch):
    """A copy of the good folder to spoil, and the current directory."""
    monkeypatch.chdir(shutil.copytree(good, tmp_path / "here"))
    return tmp_path / "here"


def test_91_cases_in_the_library_and_89_on_the_command_line_have_names_of_their_own():
    assert len({case.name for case in CASES}) == len(CASES)
    assert sum(case.call is not None for case in CASES) == 91
    assert sum(bool(case.command) for case in CASES) == 89


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.call))
def test_in_the_library_it_is_one_line_of_a_typed_exception_and_nothing_changes(case, folder):
    in_the_library(case, folder)


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.command))
def test_on_the_command_line_it_is_one_line_a_status_and_nothing_changes(case, folder, monkeypatch, capfd):
    on_the_command_line(case, folder, monkeypatch, capfd)
