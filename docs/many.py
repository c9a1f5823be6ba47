"""Made-up configurations of many seeds, to see what their report costs: the committed rows again and again,
as further seeds.

    python docs/many.py 1000 build/many
    uavnav report build/many

writes the paper's eight configurations with so many seeds each, without policies.
"""

import argparse
import itertools
import shutil
from pathlib import Path

import pandas as pd
import yaml

from uavnav.runs.paper import TABLES
from uavnav.runs.tables import write_table

RESULTS = Path(__file__).parent.parent / "results" / "vectorised"


def copy(configuration: Path, out: Path, seeds: int) -> None:
    """A configuration whose rows are repeated until it has so many seeds."""
    out.mkdir(parents=True)
    config = yaml.safe_load((configuration / "config.yaml").read_text())
    own, first = config["n_seeds"], config["seed"]
    (out / "config.yaml").write_text(yaml.safe_dump(config | {"n_seeds": seeds}))
    shutil.copy(configuration / "meta.json", out)
    for name in ("episodes", "progress", "evaluation"):
        rows = pd.read_parquet(configuration / f"{name}.parquet")
        times = itertools.takewhile(lambda time: time * own < seeds, itertools.count())
        many = pd.concat([rows.assign(seed=rows["seed"] + time * own) for time in times], ignore_index=True)
        many = many[many["seed"] < first + seeds].reset_index(drop=True)
        many.attrs = rows.attrs
        write_table(out / f"{name}.parquet", many)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for algorithm, activation in TABLES:
        copy(RESULTS / algorithm / activation, arguments.out / algorithm / activation, arguments.seeds)


if __name__ == "__main__":
    main()
