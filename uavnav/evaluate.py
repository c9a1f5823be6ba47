"""Fly policies on sets of obstacles that they never trained on: one row an episode.

`python -m uavnav.evaluate RUN...` evaluates every seed of finished runs, greedy and sampled, into their folders; and
whatever else flies (scripted baselines, zips of Stable-Baselines3), whose rows `--out` keeps for a report.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from uavnav import graph, policies
from uavnav.choices import Parser, did_you_mean_run
from uavnav.files import check_out
from uavnav.runs import BEHAVIOUR, EVALUATION, Run
from uavnav.runs.metrics import EPISODE_COLUMNS, MODES
from uavnav.runs.tables import RunError, lock, write_table
from uavnav.tasks import layouts as banks
from uavnav.tasks import simulator
from uavnav.tasks.baselines import BASELINES, AnyPolicy
from uavnav.tasks.seeding import stream
from uavnav.tasks.simulator import COUNTS, UP, Outcome, State
from uavnav.tasks.world import World
from uavnav.training import machine
from uavnav.training.display import evaluation_summary, flights, print_table

EPISODES = 200
MAX_STEPS = 10_000
WATCHED_LAYOUTS = 10
WATCHED_STEPS = 500
"""Behaviour is kept of so many sets of obstacles, and of so many steps of each."""

DEFAULT = World()

BEHAVIOUR_COLUMNS = {
    "seed": "int64",
    "layout": "int64",
    "step": "int64",
    "x": "float32",  # [px], after the step
    "y": "float32",  # [px]
    "heading": "int16",  # [degrees]
    "clearance": "float32",  # [px] to the nearest obstacle or border square
    "action": "int16",
}


class Flights(NamedTuple):
    """What an evaluation leaves."""

    episodes: pd.DataFrame  # one row an episode, `metrics.EPISODE_COLUMNS`
    behaviour: pd.DataFrame  # one row a watched step, `BEHAVIOUR_COLUMNS`


def evaluate_policy(
    policy: AnyPolicy,
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    world: World | None = None,
    reward: str | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """One episode on each of the first sets of a bank, each starting at the centre.

    Args:
        policy: what `uavnav.load_policy` returns, or any callable of that form.
        layouts: `train`, `test`, a bank's path, or a tensor [n, k, 3].
        episodes: how many sets, from the first.
        max_steps: an episode that lasts so long is cut off: `truncated`, a censored observation and no collision.
        world: constants and switches; by default those that the policy was trained in, if it has any.
        reward: a name of `uavnav.rewards.REWARDS`; by default the policy's, or eq14.
        seed: of the generator that the policy is given; also written into the column `seed`.

    Returns:
        A row an episode, the columns of `metrics.EPISODE_COLUMNS` (`frame` is the step of its end, `world` its row).

    Raises:
        LayoutError: the bank cannot be read.
        ValueError: an unknown reward, more episodes than the bank has sets, or a count below 1.
    """
    world = world or getattr(policy, "world", None) or World()
    reward = reward or getattr(policy, "reward", None) or "eq14"
    return fly({seed: policy}, layouts, episodes, max_steps, world, reward).episodes


def fly(
    population: dict[int, AnyPolicy],
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    world: World = DEFAULT,
    reward: str = "eq14",
    tell: Callable[[int, int], object] = lambda step, up: None,
) -> Flights:
    """Evaluate one policy a seed, the flights of all of them in one batch; arguments as of `evaluate_policy`.

    `tell` is called after each step with its number and how many flights go on.

    What one seed does depends neither on the others nor on anything but its policy and a generator of its own. Random
    start headings, where the world has them, are those of the set of obstacles, the same for every policy.
    """
    if not isinstance(episodes, int) or not isinstance(max_steps, int):
        raise ValueError(f"episodes={episodes}, max_steps={max_steps}; give whole numbers")
    simulator.check_rules(reward, max_steps if max_steps >= 1 else None)
    bank = banks.resolve(layouts, world)
    if not 1 <= episodes <= len(bank) or max_steps < 1:
        raise ValueError(
            f"episodes={episodes}, max_steps={max_steps}; give 1 to {len(bank)} episodes of at least 1 step"
        )
    generators = {seed: torch.Generator().manual_seed(seed) for seed in population}
    layout = torch.arange(episodes).repeat(len(population))
    seed = torch.tensor(list(population)).repeat_interleave(episodes)
    heading = torch.full((episodes,), UP)
    if world.start_heading == "random":
        heading = torch.randint(360, (episodes,), generator=stream(0, "headings in evaluation"))
    state = simulator.start(layout, heading.repeat(len(population)), world)

    def step(action: Tensor, bank: Tensor, *fields: Tensor) -> tuple[Tensor, ...]:
        state, outcome = simulator.step(State(*fields), action, bank, world, reward, max_steps)
        return *state, *outcome

    compiled = machine.flights(len(layout), max_steps)
    advance = graph.Graph(step) if compiled else step
    ended: list[dict[str, Tensor]] = []
    watched: list[dict[str, Tensor]] = []
    up = torch.arange(len(layout))  # rows whose flight goes on; the others stand still, or are dropped
    with torch.no_grad():
        observation, _ = simulator.observe(state, bank, world)
        for count in range(1, max_steps + 1):
            rows = [observation[up[seed[up] == one]] for one in population]
            flying = [(one, seen) for one, seen in zip(population, rows, strict=True) if len(seen)]
            chosen = [_checked(population[one](seen, generators[one]), len(seen), world) for one, seen in flying]
            action = torch.zeros_like(seed)
            action[up] = torch.cat(chosen)
            found = advance(action, bank, *state)
            state, outcome = State(*found[: len(state)]), Outcome(*found[len(state) :])
            if count <= WATCHED_STEPS:
                watched.append(_watch(up, seed, state, outcome, action))
            done = (outcome.terminated | outcome.truncated)[up]
            observation = outcome.observation
            if done.any():
                ended.append(_end(up[done], seed, state, outcome))
                up = up[~done]
                if not compiled:
                    seed, observation, state = seed[up], observation[up], State(*(field[up] for field in state))
                    up = torch.arange(len(up))
            tell(count, len(up))
            if not len(up):
                break
    return Flights(
        _table(ended, EPISODE_COLUMNS).sort_values(["seed", "layout"], ignore_index=True),
        _table(watched, BEHAVIOUR_COLUMNS).sort_values(["seed", "layout", "step"], ignore_index=True),
    )


def _checked(action: Tensor, n: int, world: World) -> Tensor:
    """A policy's actions, if they are some."""
    fits = isinstance(action, Tensor) and action.shape == (n,) and action.dtype in (torch.int64, torch.int32)
    if not fits or not 0 <= int(action.min()) <= int(action.max()) < world.n_actions:
        shown = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) and not fits else repr(action)
        raise ValueError(f"a policy chose {shown}; it must give int64 [{n}] from 0 to {world.n_actions - 1}")
    return action


def _end(rows: Tensor, seed: Tensor, state: State, outcome: Outcome) -> dict[str, Tensor]:
    counts = {name: getattr(state, name)[rows] for name in ("layout", *COUNTS)}
    flags = {"terminated": outcome.terminated[rows], "truncated": outcome.truncated[rows]}
    return {"seed": seed[rows], "frame": state.steps[rows], "world": state.layout[rows], **counts, **flags}


def _watch(rows: Tensor, seed: Tensor, state: State, outcome: Outcome, action: Tensor) -> dict[str, Tensor]:
    kept = rows[state.layout[rows] < WATCHED_LAYOUTS]
    fields = {name: getattr(state, name)[kept] for name in ("layout", "x", "y", "heading")}
    return {
        "seed": seed[kept],
        "step": state.steps[kept],
        "clearance": outcome.clearance[kept],
        "action": action[kept],
        **fields,
    }


def _table(parts: list[dict[str, Tensor]], columns: dict[str, str]) -> pd.DataFrame:
    return pd.DataFrame({name: torch.cat([part[name] for part in parts]).numpy() for name in columns}).astype(columns)


def evaluate_run(
    run: Run,
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    layouts: str | Path = "test",
    quiet: bool = False,
) -> pd.DataFrame:
    """Evaluate every seed of a run, greedy and sampled, and keep the rows in its folder if it is on the test split.

    Training's generators play no part, and nothing else in the folder changes. On a terminal a bar shows how far it is,
    unless it is `quiet`.

    Returns:
        What `evaluation.parquet` holds: the columns of `metrics.EPISODE_COLUMNS` and `mode`; in `attrs`, and in the
        file's header, the bank and the cap.

    Raises:
        LayoutError, PolicyError, RunError: the bank or the run's policy cannot be read, or its folder not be written.
    """
    flown = {}
    with machine.use_threads(1):
        for mode in MODES:
            population = {seed: policies.load_policy(run.path, seed, greedy=mode == "greedy") for seed in run.seeds}
            own = population[run.seeds[0]]
            what = f"{run.algorithm} {run.config['activation']}, {mode}"
            with flights(what, episodes * len(population), max_steps, quiet) as tell:
                flown[mode] = fly({**population}, layouts, episodes, max_steps, own.world, own.reward, tell)
    rows = pd.concat([part.episodes.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
    rows.attrs = header(layouts, max_steps)
    behaviour = pd.concat([part.behaviour.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
    if layouts == "test":
        with lock(run.path):
            write_table(run.path / EVALUATION, rows)
            write_table(run.path / BEHAVIOUR, behaviour)
    return rows


def header(layouts: str | Path, max_steps: int) -> dict[Any, Any]:
    """What the header of a file of rows says of how they were flown."""
    return {"layouts": str(layouts), "max_steps": max_steps}


def _found(name: str, activation: str | None) -> Run | dict[str, AnyPolicy]:
    """A run, or what else flies, by its mode."""
    if name in BASELINES:
        return {"scripted": BASELINES[name]}
    if policies.is_zip(name):
        return {mode: policies.load_policy(name, greedy=mode == "greedy", activation=activation) for mode in MODES}
    try:
        return Run(name)
    except RunError as error:
        raise RunError(f"{error}{did_you_mean_run(name, BASELINES)}") from error


def _rows_file(name: str, mode: str) -> str:
    """Where the rows of what is no run are kept; a report calls them so."""
    return f"{name}.parquet" if name in BASELINES else f"{Path(name).stem}-{mode}.parquet"


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate finished runs, scripted baselines or zips of Stable-Baselines3 on the test split: one row an episode."""
    parser = Parser(
        prog="python -m uavnav.evaluate",
        description=main.__doc__,
        epilog="example: python -m uavnav.evaluate runs/ppo/relu reactive --episodes 200",
    )
    parser.add_argument(
        "runs", nargs="+", metavar="RUN", help=f"a run's folder, a Stable-Baselines3 .zip, or {', '.join(BASELINES)}"
    )
    parser.add_argument("--episodes", type=int, default=EPISODES, help=f"sets of obstacles (default: {EPISODES})")
    parser.add_argument("--max-steps", type=int, default=MAX_STEPS, help=f"cap on steps (default: {MAX_STEPS:,})")
    parser.add_argument("--layouts", default="test", help="test, train or a bank's path (default: test)")
    parser.add_argument("--activation", help="of a .zip's hidden layers, which its weights do not tell")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="keep rows of what is no run there; a report looks in its baselines/"
    )
    arguments = parser.parse_args(argv)
    try:
        zips = policies.zips(arguments.runs, arguments.activation)
        if arguments.out is not None and len({Path(name).stem for name in zips}) < len(zips):
            raise ValueError(f"--out {arguments.out}: two zips of one name would share a file; rename one")
        found = {name: _found(name, arguments.activation) for name in arguments.runs}
        if arguments.out is not None:
            for name, run in found.items():
                for mode in () if isinstance(run, Run) else run:
                    check_out(arguments.out / _rows_file(name, mode))
        for name, run in found.items():
            if isinstance(run, Run):
                rows = evaluate_run(run, arguments.episodes, arguments.max_steps, arguments.layouts)
                print_table(evaluation_summary(rows, run.algorithm, run.config["activation"]))
                kept = arguments.layouts == "test"
                print(f"the rows are in {run.path / EVALUATION}" if kept else "rows of the test split alone are kept")
            else:
                bounds, flown = (arguments.layouts, arguments.episodes, arguments.max_steps), {}
                for mode, policy in run.items():
                    with machine.use_threads(1), flights(f"{name}, {mode}", *bounds[1:]) as tell:
                        flown[mode] = fly({0: policy}, *bounds, tell=tell).episodes
                rows = pd.concat([part.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
                print_table(evaluation_summary(rows, name if name in BASELINES else Path(name).stem))
                for mode, part in flown.items() if arguments.out is not None else ():
                    path = arguments.out / _rows_file(name, mode)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    part.attrs = header(arguments.layouts, arguments.max_steps)
                    write_table(path, part)
                    print(f"the rows are in {path}")
    except (RunError, ValueError, OSError) as error:
        print(f"uavnav.evaluate: {policies.as_option(error)}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
