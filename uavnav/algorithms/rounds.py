"""Rounds of learning from replay, many of them as one graph: each takes steps, then makes updates.

With one environment, a round is 4 steps and an update, and calling two graphs and the ring takes longer than
the arithmetic. What a round draws does not depend on what it sees. So everything is drawn first, and the
rows of these rounds are written last. The bits are those of rounds one by one.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from uavnav import graph
from uavnav.acting import Actor
from uavnav.algorithms.replay import Replay, ReplayConfig
from uavnav.envs.env import DroneEnv
from uavnav.errors import telling_line
from uavnav.training.checkpoints import Stateful
from uavnav.training.update import Learner, unflattened

ROUNDS = 25
"""Rounds in one graph. 25 divides 1,250, the rounds between two rows of progress in one environment."""
LEAST_ROUNDS = 20_000
"""Of a run for which compiling them together pays."""
MOST_UPDATES = 4
"""Gradient steps of a round; with more, calls cost less than a tenth of it."""


class Rounds:
    """The rounds of a run.

    Args:
        config: of the run.
        actor, replay, learner: its parts.
        renews: whether the round that ends after so many frames renews the target, which a graph does not.
    """

    def __init__(
        self,
        config: ReplayConfig,
        actor: Actor,
        replay: Replay,
        learner: Learner,
        renews: Callable[[int], bool] = lambda frames: False,
    ) -> None:
        self.config, self.actor, self.renews = config, actor, renews
        self.replay, self.learner = replay, learner
        n_updates, room = config.updates_per_step, replay.storage.max_size // config.frames_per_iteration
        small = learner.on_cpu and not learner.in_turn and n_updates <= MOST_UPDATES
        long = config.updates // n_updates >= LEAST_ROUNDS and room >= ROUNDS
        self._possible = learner.compile and small and long
        self._graph: graph.Scan | None = None
        self._closed_over: Sequence[Tensor] = ()

    def ready(self, env: DroneEnv, frames: int) -> bool:
        """Whether the next rounds are one graph: all learn, and none ends with a row of progress, a policy to
        keep or a new target.
        """
        config = self.config
        if not (self._possible and frames >= config.frames_before_learning and env.whole(self.actor)):
            return False
        ends = [frames + n * config.frames_per_iteration for n in range(1, ROUNDS + 1)]
        if ends[-1] > config.frames or any(
            config.logs(end) or config.shares_reached(end) or self.renews(end) for end in ends
        ):
            return False
        if self._graph is None:
            self._possible = self._compile(env)
        return self._possible

    @torch.no_grad()
    def run(self, env: DroneEnv) -> TensorDict:
        """The next rounds; their steps [A, W, T]."""
        config, replay, learner, n = self.config, self.replay, self.learner, self.learner.n_changed
        n_rows, n_updates = config.frames_per_iteration, config.updates_per_step
        drawn = env.draw(self.actor, ROUNDS * n_rows // config.n_envs)
        found = self._call(env, drawn, replay.draw_ahead(ROUNDS, n_rows, n_updates, config.batch_size))
        now, learned, (rows,), steps = graph.parts(found, len(env.tensors), n, 1)
        env.go_on(now)
        for value, new in zip(learner.tensors[:n], learned, strict=True):
            value.copy_(new)
        learner.steps += ROUNDS * n_updates
        replay.write(rows)
        # [K, A, W, T, ...] -> [A, W, K T, ...]
        return env.batch([one.movedim(0, 2).flatten(2, 3) for one in steps])

    def _call(self, env: DroneEnv, drawn: Sequence[Tensor], places: Sequence[Tensor]) -> Sequence[Tensor]:
        """The graph, from where everything is: the next state, and what `env.batch` takes.

        drawn: random numbers of all steps; places: as of `draw_ahead`.
        """
        learner, ring, n = self.learner, self.replay.storage.ring, self.learner.n_changed
        n_rows = ROUNDS * self.config.frames_per_iteration
        rates, where = learner.rates(ROUNDS * self.config.updates_per_step), torch.arange(n_rows)
        inputs = [one.reshape(ROUNDS, -1, *one.shape[1:]) for one in (*drawn, rates, where)]
        state = [*env.tensors, *learner.tensors[:n], ring.new_zeros(n_rows, *ring.shape[1:])]
        constants = [*env.constants, ring, *learner.tensors[n:]]
        if self._graph is None:
            self._graph, self._closed_over = self._made(env, state, [*inputs, *places], constants)
        return self._graph(*state, *inputs, *places, *constants, *self._closed_over)

    def _compile(self, env: DroneEnv) -> bool:
        """Try the graph, which changes nothing but streams that are put back; whether there is one."""
        config = self.config
        streams: tuple[Stateful, ...] = env, self.actor
        before = [one.state_dict() for one in streams]
        drawn = env.draw(self.actor, ROUNDS * config.frames_per_iteration // config.n_envs)
        for one, state in zip(streams, before, strict=True):
            one.load_state_dict(state)
        successors = len(self.replay.sampler.successors)
        shape = ROUNDS, config.n_seeds, config.updates_per_step, config.batch_size, 1 + successors
        try:
            self._call(env, drawn, [torch.zeros(shape, dtype=torch.int64) for _ in range(2)])
        except Exception as error:  # as of `graph.Graph`
            why = telling_line(error.__cause__ or error)
            warnings.warn(f"rounds run one by one, slower ({why})", stacklevel=2)
            return False
        return True

    @torch.no_grad()
    def _made(
        self, env: DroneEnv, state: Sequence[Tensor], inputs: Sequence[Tensor], constants: Sequence[Tensor]
    ) -> tuple[graph.Scan, Sequence[Tensor]]:
        """The graph, and what its steps close over.

        state: the environment's; weights and what else an update changes; rows of these rounds.
        inputs of a round: random numbers; rates; where its rows are among those; `places`, `fresh`.
        constants: the environment's; the ring; what else an update is given.
        """
        n_now, n_drawn, n_known = len(env.tensors), len(inputs) - 4, len(env.constants)
        names = {id(weight): str(name) for name, weight in self.learner.params.items()}
        weights = [names[id(weight)] for weight in self.actor.weights]
        *drawn, rates, _, places, fresh = (one[0] for one in inputs)
        ring, *kept = constants[n_known:]
        acting = [*state[:n_now], *drawn, *env.constants, *self.actor.weights]
        steps, closed_over = env.scan(self.actor, n_drawn).within(acting)
        learning = [rates, *state[n_now:-1], *kept, ring, state[-1], places, fresh]
        updates = self.learner.loop(["places", "fresh"], 2).within(learning)
        numbers = n_now, self.learner.n_changed, 1, n_drawn, 4, n_known, 1, len(kept)

        def one_round(*tensors: Tensor) -> Sequence[Tensor]:
            now, learned, (rows,), drawn, others, known, (ring,), kept, more = graph.parts(tensors, *numbers)
            rates, where, places, fresh = others
            named = unflattened(learned[0], self.learner.params)
            acting = [named[name].clone() for name in weights]  # a scan takes no two views of one tensor
            found = steps(*now, *drawn, *known, *acting, *more)
            rows = rows.index_copy(0, where, self.replay.rows(env.batch(found[n_now:])))
            _, *learned = updates(rates, *learned, *kept, ring, rows, places, fresh)
            return *found[:n_now], *learned, rows, *found[n_now:]

        return graph.Scan(one_round, len(state), len(inputs), strict=True, cpp_wrapper=True), closed_over
