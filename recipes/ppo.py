"""Train PPO to fly the drone and compare it with the paper: `uavnav train ppo` as one page, to read and
to change.

    python recipes/ppo.py activation=relu
    python recipes/ppo.py activation=relu n_seeds=4 total_frames=1e6 preset=paper device=cpu
    out=runs/mine python recipes/ppo.py -m activation=relu,leaky_relu,tanh,sigmoid

`python recipes/ppo.py --help` says what each key means. All seeds learn side by side in this process, where
`uavnav train ppo` spreads those of a long run over the cores. Letters: A seeds, W environments per seed, T
steps.
"""

import sys

from uavnav.__main__ import launch  # before PyTorch

# isort: split
import torch

from uavnav.acting import Actor
from uavnav.algorithms.ppo import (
    LEARNED,
    PPOLoss,
    clip_bound,
    diagnostics,
    estimate,
    make_networks,
)
from uavnav.algorithms.rollout import minibatches
from uavnav.runs import Run
from uavnav.tasks.seeding import Streams
from uavnav.training.display import Tell
from uavnav.training.loop import Session, make_env
from uavnav.training.recorder import Recorder
from uavnav.training.update import Adam, Learner


def train(recorder: Recorder, quiet: bool, tell: Tell | None) -> Run:
    session = Session(recorder, quiet, tell)
    config = session.config

    # environment: [A, W] rows of the task
    env = make_env(config, session.compile)

    # networks: observation [A, ..., 30] -> logits [A, ..., 100] and value [A, ..., 1]
    policy, value = make_networks(config)
    actor = Actor(policy, config.seeds, "categorical", "direct", session.compile)

    # loss: equations (2) and (4)
    loss = PPOLoss(policy, value, config).to(config.device)

    # update: Adam on each seed's own gradient, whose norm is clipped
    adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
    learner = Learner(loss, loss.names, adam, max_grad_norm=config.max_grad_norm, compile=session.compile)
    orders = Streams(config.seeds, "minibatches")

    # loop: collect a rollout [A, W, T], learn from it for some epochs, and note what became of the policy
    networks, parts = {"policy": policy, "value": value}, {"minibatches": orders, "learner": learner}
    with session.open(env, actor, networks, parts):
        for _, batch in session.batches():
            estimate(batch, policy, value, config)  # advantages by equation (3)
            epochs = [
                learner.learn(minibatches(batch, orders, config.minibatch_size, LEARNED))
                for _ in range(config.epochs)
            ]
            losses = {name: torch.stack([epoch[name] for epoch in epochs]).mean(0) for name in epochs[0]}
            session.log({**losses, **diagnostics(batch, policy, clip_bound(config))})
        return session.finish()


if __name__ == "__main__":
    sys.exit(launch(["train", "ppo", *sys.argv[1:]], fit=train))
