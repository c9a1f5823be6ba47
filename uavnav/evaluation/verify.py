"""`uavnav verify RUN [--frames N]`: repeat a run and say whether its rows and weights are the same bits."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch

from uavnav import plugins
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, choose_from
from uavnav.runs import KEPT, POLICY, Run, read_settings
from uavnav.runs.metrics import finished
from uavnav.runs.policies import PolicyError, contents
from uavnav.runs.tables import RunError
from uavnav.settings import Count, checked
from uavnav.training import workers
from uavnav.training.config import TrainConfig
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted

TIMING = ["frames_per_second"]  # columns that two equal runs may differ in


class Verdict(NamedTuple):
    """What a repeat showed."""

    same: bool
    lines: list[str]


def verify(run: Run, frames: int | None = None, quiet: bool = False) -> Verdict:
    """Repeat a run, or its first `frames` frames per seed, in a scratch folder and compare.

    At the end of a whole run weights are compared too: a repository may keep only rows, or some seeds.

    Raises:
        ConfigError, LayoutError, RunError: the run cannot be repeated.
    """
    checked("frames", frames, Count | None)
    config = _config(run)
    files = [POLICY, *(path.name for path in sorted(run.path.glob(f"{KEPT}*")))]
    original, kept = _weights(run.path, files) if (run.path / POLICY).exists() else (None, run.seeds)
    whole = frames is None or frames >= run.frames
    how: dict[str, Any] = {name: int(run.meta.get(name, 1)) for name in ("processes", "threads")}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "again"
        if whole:
            again = train(config, out=folder, quiet=quiet, **how)
            reached, meta, (weights, _) = again.frames, again.meta, _weights(folder, files)
            tables = {"episodes": again.episodes, "progress": again.progress}
        else:
            try:
                train(config, out=folder, quiet=quiet, until=frames, **how)
            except Interrupted as stop:
                if not stop.wanted:
                    raise
            reached, tables = workers.snapshot_tables(folder, config)
            meta, weights = read_settings(folder / "meta.json"), None
    originals = {"episodes": run.episodes, "progress": run.progress}
    kept_from, progress = 0, tables["progress"]
    if len(run.progress) and len(progress):  # a folder may keep the last rows only
        kept_from = run.progress["frame"].min()
        tables["progress"] = progress[progress["frame"] >= kept_from]
    if not whole:
        originals = {name: table[table["frame"] <= reached] for name, table in originals.items()}
        originals["episodes"] = finished(originals["episodes"])
    partings = [_parting(name, originals[name], tables[name]) for name in originals]
    if weights is not None and original is not None:
        if kept and {*kept} <= {*run.seeds}:
            weights = {name: one[[run.seeds.index(seed) for seed in kept]] for name, one in weights.items()}
            partings.append(_weights_parting(original, weights))
        else:
            partings.append(f"  weights: of the seeds {kept} then, {run.seeds} now")
    lines = [line for line in partings if line]
    if lines:
        lines += [f"  {fact}: {there} then, {here} now" for fact, there, here in _differing(run.meta, meta)]
        return Verdict(False, [f"{run.path}: not the same", *lines])
    compared = f"{len(originals['episodes']):,} episodes, {len(originals['progress']):,} rows of progress"
    if weights is not None and original is not None:
        fewer = "" if kept == run.seeds else f" of {len(kept)} of its {len(run.seeds)} seeds"
        compared += f" and {len(weights)} tensors{fewer}"
    lines = [f"{run.path}: the same, bit for bit: {compared} at {reached:,} frames per seed"]
    for name, table in originals.items():
        more = tables[name].drop(columns=[*table, *TIMING], errors="ignore").dropna(axis=1, how="all")
        if len(more.columns):
            lines.append(
                f"  {name}: not compared, as the folder leaves them out: {', '.join(map(str, more))}"
            )
    if len(tables["progress"]) < len(progress):
        lines.append(
            f"  progress: not compared before frame {kept_from:,}, as the folder leaves those rows out"
        )
    if original is None:
        lines.append(f"  weights: not compared, no {POLICY} there; the run's command makes it")
    return Verdict(True, lines)


def _config(run: Run) -> TrainConfig:
    if run.algorithm not in ALGORITHMS:
        hint = plugins.missing(run.meta.get("plugins", {})) or f"; {choose_from(run.algorithm, ALGORITHMS)}"
        raise RunError(f"{run.path / 'config.yaml'}: algorithm={run.algorithm}{hint}")
    kind: type[TrainConfig] = ALGORITHMS[run.algorithm].config
    try:
        return kind.from_mapping(kind.as_run(run.config))
    except (ConfigError, KeyError, TypeError) as error:
        hint = plugins.missing(run.meta.get("plugins", {}))
        raise ConfigError(f"{run.path / 'config.yaml'}: {error}{hint}") from error


def _parting(name: str, there: pd.DataFrame, here: pd.DataFrame) -> str:
    """Where two tables part first, in words; empty where they do not."""
    shorter = "" if len(there) == len(here) else f"  {name}: {len(there):,} rows then, {len(here):,} now"
    there, here = (
        table.drop(columns=TIMING, errors="ignore").reset_index(drop=True) for table in (there, here)
    )
    rows = min(len(there), len(here))
    if not rows:  # a table without rows need not have columns
        return shorter
    known = [column for column in there if column in here or there[column].notna().any()]
    if not {*known} <= {*here}:
        return f"  {name}: other columns"
    there, here = there[known], here[known]  # a folder may leave out what nobody reads
    equal = (there[:rows] == here[:rows]) | (there[:rows].isna() & here[:rows].isna())
    wrong = ~equal.all(axis=1)
    if not wrong.any():
        return shorter
    index = int(wrong.idxmax())
    column = equal.columns[~equal.iloc[index].to_numpy(dtype=bool)][0]
    was, now = there.iloc[index].to_dict(), here.iloc[index].to_dict()
    where = f"row {index} (seed {was['seed']:.0f}, frame {was['frame']:,.0f})"
    return f"  {name}: {where} is the first with another {column}: {was[column]} then, {now[column]} now"


def _weights(folder: Path, files: Sequence[str]) -> tuple[dict[str, torch.Tensor], list[int]]:
    """The tensors of policy files, of those kept on the way by their file too, and the seeds in them."""
    found: dict[str, torch.Tensor] = {}
    for name in files:
        try:
            tensors, header = contents(folder / name)
        except PolicyError as error:
            raise RunError(f"{folder / name}: missing or damaged; run again with overwrite=true") from error
        where = "" if name == POLICY else f"{name}: "
        found |= {where + key: tensor for key, tensor in tensors.items()}
    return found, header.seeds


def _weights_parting(there: dict[str, torch.Tensor], here: dict[str, torch.Tensor]) -> str:
    if there.keys() != here.keys():
        return "  weights: other tensors"
    for name, tensor in there.items():
        other = here[name]
        if (tensor.shape, tensor.dtype) != (other.shape, other.dtype):
            return f"  weights: {name} is {_kind(tensor)} then, {_kind(other)} now"
        if tensor.numpy().tobytes() != other.numpy().tobytes():
            return f"  weights: {name} differs by up to {(tensor - other).abs().max():.2g}"
    return ""


def _kind(tensor: torch.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"


def _differing(there: dict[str, Any], here: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Facts of version, machine and layouts in which two runs differ."""
    single = ("git_commit", "threads", "processes", "compiled")
    pairs = [(key, there.get(key), here.get(key)) for key in single]
    for group in ("versions", "machine", "layouts", "plugins"):
        old, new = (facts[group] if isinstance(facts.get(group), dict) else {} for facts in (there, here))
        pairs += [(f"{group}.{key}", old.get(key), new.get(key)) for key in sorted({*old, *new})]
    return [pair for pair in pairs if pair[1] != pair[2]]
