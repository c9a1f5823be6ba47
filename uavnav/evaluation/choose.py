"""Choose the policies that ship: of each run the seed with the most reward on the validation split.

`make policies`, or `python -m uavnav.evaluation.choose results`, writes them and `chosen.json`. Both rewards
of a seed count, the greedy one and the sampled one, as users fly policies in both ways.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pandas as pd
from safetensors.torch import save

from uavnav.evaluation import fly_modes, on
from uavnav.files import write
from uavnav.runs import POLICY, Run, paper
from uavnav.runs.policies import by_mode, contents, load_policies
from uavnav.runs.shipped import CHOSEN, FOLDER, SUFFIX
from uavnav.training import machine

RUNS = {
    **{
        f"{algorithm}-{activation}": f"paper/{algorithm}/{activation}"
        for algorithm, activation in paper.TABLES
    },
    **{f"{algorithm}-fast-tanh": f"algorithms/fast/{algorithm}/tanh" for algorithm in ("ppo", "dqn")},
    "ppo-best": "learned/drone/ppo/tanh",
    "pqn-best": "learned/drone/pqn/relu",
}
"""By the name of a policy, its run below the folder of results."""
LAYOUTS = "validation"


def main(results: Path) -> None:
    """Evaluate every seed of each run, and write the best one's policy."""
    chosen = {}
    for name, folder in sorted(RUNS.items()):
        run = Run(results / folder, rows=False)  # its evaluation is of the test split
        modes = by_mode(load_policies(run.path))
        task = on(next(iter(modes["greedy"].values())).task, LAYOUTS)
        with machine.use_threads(1):
            rows = fly_modes(modes, task).episodes
        tested = run.evaluation()
        assert tested is not None, f"{run.path}: evaluate it on the test split first"
        validation, test = _rewards(rows), _rewards(tested)
        seed = int(validation.mean(axis=1).idxmax())
        chosen[name] = {
            "run": f"{results.name}/{folder}",
            "algorithm": run.algorithm,
            **{key: run.config[key] for key in ("activation", "preset")},
            "seed": seed,
            "frames": run.frames,
            LAYOUTS: validation.loc[seed].to_dict(),
            "test": test.loc[seed].to_dict(),
        }
        write(FOLDER / f"{name}{SUFFIX}", one_seed(run.path / POLICY, seed))
        print(name, chosen[name], flush=True)
    write(CHOSEN, json.dumps(chosen, indent=2).encode() + b"\n")


def _rewards(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean rewards of an episode: a row a seed, a column a mode."""
    return rows.pivot_table("reward", "seed", "mode").round(2)


def one_seed(path: Path, seed: int) -> bytes:
    """A policy file of one seed of another, without what no action depends on."""
    tensors, header = contents(path)
    agent = header.seeds.index(seed)
    own = {
        key: one[agent : agent + 1].contiguous() for key, one in tensors.items() if key.startswith("policy.")
    }
    said = header.model_copy(update={"seeds": [seed]}).model_dump(exclude_unset=True)
    return save(own, {"uavnav": json.dumps(said)})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
