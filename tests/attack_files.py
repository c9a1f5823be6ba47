"""Hostile study files and damaged files, as `attack_inputs` has other input; and the good files that are
damaged.
"""

import contextlib
import hashlib
import json
import random
from pathlib import Path

import numpy as np
import pandas as pd
import warm
import yaml
from attack_inputs import (
    NESTED,
    NUMBERS,
    OWN,
    POLICY,
    QUICK,
    SMALL,
    WORDS,
    Case,
    command,
    hostile,
    shown,
    texts,
    word,
)
from bad_input import a_folder, a_pipe, cut, endless, itself, missing, put
from hypothesis import strategies as st

import uavnav
from uavnav import evaluation, files, studies
from uavnav.algorithms import ALGORITHMS, dqn, ppo
from uavnav.cli import commands, worker
from uavnav.studies import search, tuning
from uavnav.tasks import layouts
from uavnav.training.recorder import Interrupted

# -- study files ---------------------------------------------------------------------------------------------

PLAIN = {
    "what": "one configuration",
    "settings": {"activation": ["tanh"], "n_seeds": 2, "evaluate": {"episodes": 2, "max_steps": 5}, **SMALL},
    "configurations": [{"algorithm": "ppo", "hidden": [[4]], **OWN["ppo"]}],
}
FULL = {
    **PLAIN,
    "obstacles": [4],
    "scripted_folder": "baselines",
    "configurations": [
        {"algorithm": ["ppo", "a2c"], "folder": "rate-{lr}", "lr": [0.1, 0.2], "world.slots": "listed"}
    ],
    "tune": {
        "trials": 2,
        "at_once": 1,
        "settings": {
            "activation": "tanh",
            "n_seeds": 2,
            "total_frames": 64,
            "evaluate": {"episodes": 2, "max_steps": 9},
        },
        "ranges": {"rate": {"low": 1e-5, "high": 1e-2, "log": True}, "width": [32, 64]},
        "space": {"ppo": {"lr": "rate", "hidden": "width"}, "a2c": {"lr": "rate"}},
    },
}
BOMB = "a: &a [x,x]\n" + "\n".join(
    f"{b}: &{b} [*{a},*{a},*{a}]" for a, b in zip("abcdefghijk", "bcdefghijkl", strict=True)
)
RAW = (
    "",
    "[",
    "configurations",
    "configurations: [",
    "\t- x",
    "a: b: c",
    "configurations: &a [*a]",
    BOMB,
    "[" * 5000,
    "{a: " * 500,
    "- " * 5000,
)
RAW += (
    "!!python/object/apply:os.mkdir [x]",
    "configurations: !!binary x",
    "? {a: 1}\n: 2",
    "configurations: [{algorithm: ppo}]\0",
    "\ufeff",
)
RAW += (
    "configurations: [" + "{algorithm: ppo}," * 20_000 + "]",
    "--- 1\n--- 2",
    "<<: 3",
    "2001-13-45: 1",
    "configurations: {<<: [1]}",
)
RAW += (
    "x" * 3_000_000,
    "settings: {lr: [" + "1e-3," * 3000 + "]}\nconfigurations: [{algorithm: ppo, folder: '{lr}'}]",
)


def places(node, path=()):
    """Every way into a nest of lists and mappings."""
    found = [path] if path else []
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return found + [place for key, value in entries for place in places(value, (*path, key))]


def replaced(node, path, value):
    """A copy with another value at the end of a way; the key itself where the way is none."""
    if not path:
        return value
    entries = node.items() if isinstance(node, dict) else enumerate(node)
    pairs = [(key, replaced(old, path[1:], value) if key == path[0] else old) for key, old in entries]
    return dict(pairs) if isinstance(node, dict) else [old for _, old in pairs]


def dumped(value):
    """As YAML, or as JSON where YAML has no words for it."""
    try:
        return yaml.safe_dump(value)
    except Exception:
        return repr(value)


@st.composite
def study_texts(draw):
    if not draw(st.integers(0, 4)):
        text = draw(st.sampled_from(RAW) | st.text(max_size=60))
        return text, shown(text)
    said = draw(st.sampled_from([PLAIN, PLAIN, FULL]))
    changes = ["all of it" if said is FULL else "a plain one"]
    for _ in range(draw(st.integers(1, 3))):
        way = draw(st.sampled_from(places(said) or [()]))
        value = draw(hostile)
        said = replaced(said, way, value)
        changes.append(f"{'.'.join(map(str, way))}={shown(value)}")
        if isinstance(said, dict) and not draw(st.integers(0, 5)):
            key, value = draw(texts), draw(hostile)
            said = said | {key: value}
            changes.append(f"{shown(key)}: {shown(value)}")
    return dumped(said), ", ".join(changes)


@st.composite
def study_files(draw):
    text, changes = draw(study_texts())
    settings = draw(st.lists(st.sampled_from(list(commands.STUDY_KEYS)), max_size=1))
    settings = [key for key in settings if key not in ("engine",)] if draw(st.booleans()) else []
    words = [word(f"{key}={word(draw(hostile))}") for key in settings]
    status = ["--status"] * draw(st.integers(0, 1)) + ["--json"] * draw(st.integers(0, 1))
    bounds = ["out=new", "report=false", "jobs=1"]
    given = [
        one for one in bounds if not any(other.startswith(one.partition("=")[0] + "=") for other in words)
    ]

    def spoil(folder):
        (folder / "mine.yaml").write_bytes(text.encode(errors="surrogatepass"))

    return command("study", "mine.yaml", *given, *words, *status, spoil=spoil, told=f"{changes} |")


# -- damaged files -------------------------------------------------------------------------------------------

SAME = ["train", "ppo", *(word(f"{key}={word(value)}") for key, value in (SMALL | OWN["ppo"]).items())]
HALF = ["train", "dqn", *(word(f"{key}={word(value)}") for key, value in (SMALL | OWN["dqn"]).items())]
STUDY = ["study", "study.yaml", "out=study", "report=false", "jobs=1"]
READERS = {
    "run": [
        *(
            [name, "run", *QUICK.get(name, [])]
            for name in ("evaluate", "render", "export", "verify", "runs", "play")
        ),
        [*SAME, "out=run", "n_seeds=2", "evaluate=false"],
        ["compare", "run", "reactive"],
        ["report", "run", "--out", "report"],
        ["playground", "run"],
        ["evaluate", "run", "--transfer", "--episodes", "2", "--max-steps", "5"],
    ],
    "half": [
        [*HALF, "out=half", "evaluate=false"],
        ["runs", "half"],
        ["evaluate", "half"],
        ["report", "half"],
    ],
    "study": [[*STUDY, "--status"], STUDY, [*STUDY, "--status", "--json"], ["runs", "study"], ["WORKER"]],
    "tuned": [
        ["study", "tuned.yaml", "out=tuned", *words] for words in (["--status"], ["trials=2", "report=false"])
    ],
    "own.safetensors": [
        ["layouts", "--check", "own.safetensors"],
        ["evaluate", "reactive", *QUICK["evaluate"], "--layouts", "own.safetensors"],
        [*SAME, "out=new", "evaluate=false", "layouts=own.safetensors"],
    ],
}
FLOWN = [["evaluate", "{}", *QUICK["evaluate"]], ["render", "{}", *QUICK["render"]]]
READERS |= {POLICY: FLOWN, "model.zip": FLOWN, "study.yaml": [[*STUDY, "--status"]]}
SEEDED = st.integers(0, 2**32)


def flip(path, chance):
    content = bytearray(path.read_bytes())
    if content:
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    put(path, bytes(content))


def signed(path):
    """Give a snapshot the name that belongs to what it holds now, and tell it to those that name it."""
    stem = path.stem.rpartition("-")[0]
    path.rename(path.with_name(f"{stem}-{hashlib.sha256(path.read_bytes()).hexdigest()[:32]}{path.suffix}"))


def values(path, chance):
    """One value of a text, or of the header of tensors, is another."""
    other = chance.choice([*NUMBERS, *WORDS, *NESTED])
    if path.suffix == ".safetensors":
        return header(path, chance, other)
    if path.suffix == ".parquet":
        return rows(path, chance, other)
    try:
        said = yaml.safe_load(path.read_text())
        text = replaced(said, chance.choice(places(said)), other)
        return put(
            path,
            (json.dumps(text) if path.suffix in (".json", ".job") else dumped(text)).encode(errors="replace"),
        )
    except (yaml.YAMLError, UnicodeDecodeError, IndexError, TypeError):
        return lines(path, chance, other)


def lines(path, chance, other):
    """A line of a journal is another."""
    there = path.read_bytes().splitlines()
    if there:
        there[chance.randrange(len(there))] = word(other).encode(errors="replace")
    put(path, b"\n".join(there))


def header(path, chance, other):
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    said = json.loads(content[8 : 8 + size])
    inner = {
        key: json.loads(value) for key, value in said.get("__metadata__", {}).items() if value[:1] in "{["
    }
    key = chance.choice([*inner, None]) if inner else None
    if key is not None and places(inner[key]):
        said["__metadata__"][key] = json.dumps(replaced(inner[key], chance.choice(places(inner[key])), other))
    else:
        said = replaced(said, chance.choice(places(said)), other if chance.random() < 0.5 else word(other))
    text = json.dumps(said).encode()
    told = chance.choice([len(text), len(text), len(text), 0, 2**63, size + 1])
    put(path, told.to_bytes(8, "little") + text + content[8 + size :])


def rows(path, chance, other):
    table = pd.read_parquet(path)
    change = chance.choice(["rename", "words", "none", "value", "many", "more"])
    column = chance.choice(list(table))
    with contextlib.suppress(Exception):  # not every value fits into every column
        if change == "rename":
            table = table.rename(columns={column: word(other)})
        elif change == "words":
            table[column] = table[column].astype(str)
        elif change == "none":
            table = table[:0]
        elif change == "value":
            table.loc[0, column] = np.array(other).astype(table[column].dtype)
        elif change == "more":
            table[word(other)[:100]] = 0
        else:
            import pyarrow as pa
            import pyarrow.parquet as pq

            with pq.ParquetWriter(path, pa.table({name: pa.array([0]) for name in table}).schema) as writer:
                million = pa.table({name: pa.array(np.zeros(2**20, dtype=int)) for name in table})
                for _ in range(64):
                    writer.write_table(million)
            return
        table.to_parquet(path)


DAMAGES = {
    "missing": lambda path, chance: missing(path),
    "empty": lambda path, chance: put(path, b""),
    "cut": lambda path, chance: cut(chance.random())(path),
    "flipped": flip,
    "doubled": lambda path, chance: put(path, path.read_bytes() * 2),
    "a pipe": lambda path, chance: a_pipe(path),
    "endless": lambda path, chance: endless(path),
    "a folder": lambda path, chance: a_folder(path),
    "a link to itself": lambda path, chance: itself(path),
    "text": lambda path, chance: put(path, chance.choice(RAW).encode(errors="surrogatepass")),
    **{f"another value {i}": values for i in range(6)},
}


@st.composite
def damaged(draw):
    part = draw(st.sampled_from([*READERS, "run", "half", "half", "study"]))
    seed, how = draw(SEEDED), draw(st.sampled_from(list(DAMAGES)))
    words = [one.replace("{}", part) for one in draw(st.sampled_from(READERS[part]))]

    def spoil(folder):
        chance = random.Random(seed)
        root = folder / part
        path = chance.choice(
            sorted(one for one in root.rglob("*") if one.is_file()) if root.is_dir() else [root]
        )
        if words == ["WORKER"]:
            path = next(root.rglob("*.job"))
        DAMAGES[how](path, chance)
        sign = (
            path.parent.name == "checkpoint"
            and path.is_file()
            and not path.is_symlink()
            and chance.random() < 0.7
        )
        if sign and path.stem.startswith(("state-", "replay-")):
            signed(path)

    told = f"{part} (seed {seed}): {how} |"
    if words == ["WORKER"]:
        return Case(f"{told} uavnav.cli.worker", _worker, spoil)
    return command(*words, spoil=spoil, told=told)


def _worker():
    worker.main(["uavnav.algorithms.ppo:PPOConfig", str(next(Path("study").rglob("*.job")))])


# -- the good files ------------------------------------------------------------------------------------------


def warmed():
    """Import whatever a command imports."""
    for name in [
        *warm.MODULES,
        *(f"uavnav.cli.{name}" for name in commands.COMMANDS),
        *(one.module for one in ALGORITHMS.values()),
    ]:
        __import__(name)
    for name in ("optuna", "filelock", "uavnav.report.content", "uavnav.report.page", "uavnav.views.replays"):
        __import__(name)


def make_good(folder):
    """A layout file, a finished and evaluated run, a half-finished one, one in two workers, a search, a
    policy, a zip.
    """
    layouts.save(layouts.generate(20, 4, seed=0), folder / "own.safetensors", seed=0, split="train")
    run = ppo.train(ppo.PPOConfig(n_seeds=2, **SMALL | OWN["ppo"]), out="run", quiet=True)
    evaluation.evaluate_run(run, episodes=2, max_steps=5)
    for path in run.path.glob("*-test-2-5.parquet"):  # stands for 200 layouts and 10,000 steps
        path.with_name(f"{path.name.partition('-')[0]}.parquet").write_bytes(path.read_bytes())
    with contextlib.suppress(Interrupted):
        dqn.train(dqn.DQNConfig(**SMALL | OWN["dqn"]), out="half", quiet=True, checkpoint_seconds=0, until=60)
    (folder / POLICY).write_bytes((run.path / POLICY).read_bytes())
    _make_zip(folder / "model.zip")
    _make_study(folder)
    _make_search(folder)


def _make_zip(path):
    from stable_baselines3 import PPO

    PPO("MlpPolicy", uavnav.gym.DroneGymEnv(), policy_kwargs={"net_arch": [8]}, device="cpu").save(path)


def _make_study(folder):
    """One whose only configuration is half-finished, in two workers."""
    (folder / "study.yaml").write_text(
        yaml.safe_dump(PLAIN | {"settings": PLAIN["settings"] | {"total_frames": 256}})
    )
    (configuration,) = studies.configurations(studies.read("study.yaml"), folder / "study")
    with contextlib.suppress(Interrupted):
        ppo.train(
            configuration.config, configuration.out, quiet=True, checkpoint_seconds=0, processes=2, until=128
        )
    for job in configuration.out.glob("workers/*.job"):
        told = json.loads(job.read_text()) | {
            "evaluation": configuration.evaluations[0].header(),
            "folder": ".",
            "how": {},
        }
        files.write(job, json.dumps(told | {"out": str(job.with_suffix("").relative_to(folder))}).encode())


def _make_search(folder):
    """One whose trials nobody trained."""
    searched = FULL | {
        "settings": PLAIN["settings"] | {"seed": 100},
        "configurations": PLAIN["configurations"],
        "obstacles": [],
    }
    (folder / "tuned.yaml").write_text(yaml.safe_dump(searched))
    found = search.plan(studies.read("tuned.yaml"), folder / "tuned")

    def train(configurations):
        for configuration in configurations:
            configuration.out.mkdir(parents=True, exist_ok=True)
            table = pd.DataFrame(
                {"mode": ["greedy", "sampled"], "reward": [1.0, float(len(str(configuration.config.lr)))]}
            )
            table.to_parquet(configuration.out / configuration.episodes[0])
        return []

    tuning.tune(found, train, say=lambda line: None)
