"""Rounds of learning from replay, many of them as one graph: each takes steps, then makes updates.

With one environment, a round is 4 steps and an update, and calling two graphs and the ring takes longer than
the arithmetic. What a round draws does not depend on what it sees. So everything is drawn first, and the
rows of these rounds are written last. The bits are those of rounds one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from uavnav import graph
from uavnav.acting import Actor
from uavnav.algorithms.replay import Replay, ReplayConfig
from uavnav.envs.env import DroneEnv
from uavnav.training.update import Learner

ROUNDS = 25
"""In one graph: it divides the 1,250 rounds of one environment between two rows of progress."""
WORTH = 20_000
"""Rounds of a run for which compiling them together pays."""


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
        self.config, self.actor, self.replay, self.learner = config, actor, replay, learner
        self._renews = renews
        self._n_rows = config.frames_per_iteration  # of each agent in a round
        rounds, room = config.updates // config.updates_per_step, replay.storage.max_size // self._n_rows
        fast = learner.compile and learner.on_cpu and not learner.in_turn
        self._pay = fast and rounds >= WORTH and room >= ROUNDS
        self._graph: graph.Scan | None = None
        self._more: Sequence[Tensor] = ()
        self.losses: dict[str, Tensor] = {}  # of the last round

    def fit(self, env: DroneEnv, frames: int) -> bool:
        """Whether the next rounds are one graph: all learn, and between two of them there is no row of
        progress, no policy to keep and no target to renew.
        """
        config = self.config
        if not (self._pay and frames >= config.frames_before_learning and env.whole(self.actor)):
            return False
        *ends, last = (frames + n * self._n_rows for n in range(1, ROUNDS + 1))
        between = any(config.logs(end) or config.shares_reached(end) for end in ends)
        return last <= config.frames and not between and not any(map(self._renews, [*ends, last]))

    def learned(self, batch: TensorDictBase) -> bool:
        """Whether a batch is of several rounds, which have learned from it."""
        return bool(batch.shape[1:].numel() > self._n_rows)

    @torch.no_grad()
    def __call__(self, env: DroneEnv) -> TensorDict:
        """The next rounds: their steps [A, W, T], learned from already."""
        config, replay, learner = self.config, self.replay, self.learner
        n_rows, n_updates = ROUNDS * self._n_rows, config.updates_per_step
        ring, n = replay.storage.ring, learner.n_changed
        drawn = env.drawn(self.actor, n_rows // config.n_envs)
        places, newest = replay.draw_ahead(ROUNDS, self._n_rows, n_updates, config.batch_size)
        rates, where = learner.rates(ROUNDS * n_updates), torch.arange(n_rows)
        inputs = [one.reshape(ROUNDS, -1, *one.shape[1:]) for one in (*drawn, where, rates)]
        inputs += [places, newest]
        state = [*env.tensors, *learner.tensors[:n], ring.new_zeros(n_rows, *ring.shape[1:])]
        constants = [*env.constants, ring, *learner.tensors[n:]]
        if self._graph is None:
            self._graph, self._more = self._compiled(env, state, inputs, constants)
        found = self._graph(*state, *inputs, *constants, *self._more)
        now, learned, (rows, losses), steps = graph.parts(found, len(env.tensors), n, 2)
        env.go_on(now)
        for value, new in zip(learner.tensors[:n], learned, strict=True):
            value.copy_(new)
        learner.steps += ROUNDS * n_updates
        replay.write(rows)
        self.losses = dict(zip(learner.names, losses[-1], strict=True))
        # [K, A, W, T, ...] -> [A, W, K T, ...]
        return env.batch([one.movedim(0, 2).flatten(2, 3) for one in steps])

    def _compiled(
        self, env: DroneEnv, state: Sequence[Tensor], inputs: Sequence[Tensor], constants: Sequence[Tensor]
    ) -> tuple[graph.Scan, Sequence[Tensor]]:
        """The graph, and what its steps close over."""
        n_now, n_drawn, n_known = len(env.tensors), len(inputs) - 4, len(env.constants)
        weights = [_place(weight, state) for weight in self.actor.weights]
        *drawn, _, rates, places, newest = (one[0] for one in inputs)
        ring, *kept = constants[n_known:]
        acting = [*state[:n_now], *drawn, *env.constants, *self.actor.weights]
        steps, more = env.scan(self.actor, n_drawn).within(acting)
        learning = [rates, *state[n_now:-1], *kept, ring, state[-1], places, newest]
        updates = self.learner.loop(["places", "newest"], 2).within(learning)
        numbers = n_now, self.learner.n_changed, 1, n_drawn, 4, n_known, 1, len(kept)

        def one_round(*tensors: Tensor) -> Sequence[Tensor]:
            now, learned, (rows,), drawn, others, known, (ring,), kept, more = graph.parts(tensors, *numbers)
            where, rates, places, newest = others
            weights_now = [tensors[place] for place in weights]
            found = steps(*now, *drawn, *known, *weights_now, *more)
            rows = rows.index_copy(0, where, self.replay.rows(env.batch(found[n_now:])))
            losses, *learned = updates(rates, *learned, *kept, ring, rows, places, newest)
            return *found[:n_now], *learned, rows, losses, *found[n_now:]

        return graph.Scan(one_round, len(state), len(inputs), cpp_wrapper=True), more


def _place(weight: Tensor, tensors: Sequence[Tensor]) -> int:
    """Where a weight is among tensors that are other views of the same memory."""
    return next(n for n, one in enumerate(tensors) if one.data_ptr() == weight.data_ptr())
