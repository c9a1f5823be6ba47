"""Train DQN to fly the drone and compare it with the paper: `uavnav train dqn` as one page, to read and
to change.

    python recipes/dqn.py activation=sigmoid
    python recipes/dqn.py activation=relu n_seeds=4 total_frames=1e6 preset=paper device=cpu
    out=runs/mine python recipes/dqn.py -m activation=relu,leaky_relu,tanh,sigmoid

`python recipes/dqn.py --help` says what each key means. All seeds learn side by side in this process. In a
long run, `uavnav train dqn` spreads them over the cores and does 25 rounds in one call, with the same bits.
Letters: A seeds, W environments per seed, T steps.
"""

import sys

from uavnav.__main__ import launch  # before PyTorch

# isort: split
from torchrl.objectives import HardUpdate

from uavnav.acting import Actor
from uavnav.algorithms.dqn import diagnostics, make_loss, make_network, renews_target
from uavnav.algorithms.replay import make_replay
from uavnav.runs import Run
from uavnav.training.display import Tell
from uavnav.training.loop import Session, make_env
from uavnav.training.recorder import Recorder
from uavnav.training.update import Adam, Learner


def train(recorder: Recorder, quiet: bool, tell: Tell | None) -> Run:
    session = Session(recorder, quiet, tell)
    config = session.config

    # environment: [A, W] rows of the task
    env = make_env(config, session.compile)

    # network: observation [A, ..., 30] -> Q values [A, ..., 100]; the actor takes the best, or explores
    network = make_network(config).to(config.device)
    actor = Actor(
        network, config.seeds, "epsilon-greedy", config.head, session.compile, epsilon=config.epsilon
    )

    # loss: equation (1), with a target network
    loss = make_loss(network, config)
    copy_to_target = HardUpdate(loss, value_network_update_interval=0)

    # buffer: transitions (s, a, R, s'), from which each seed draws its own
    replay = make_replay(config)

    # update: Adam on each seed's own gradient, whose norm is clipped
    adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
    how = {"max_grad_norm": config.max_grad_norm, "compile": session.compile}
    how |= {"read": replay.read, "memory": [replay.storage.ring]}
    learner = Learner(loss, ["loss"], adam, **how)

    # loop: collect steps [A, W, T]; renew the target now and then; learn from minibatches of the buffer
    parts = {"replay": replay.sampler, "learner": learner}
    with session.open(env, actor, {"policy": network}, parts, replay.buffer):
        for frames, batch in session.batches():
            losses = {}
            replay.extend(batch)
            if renews_target(config, frames):
                copy_to_target.step()
            if frames > config.frames_before_learning:
                losses = learner.learn(replay.draw(config.updates_per_step, config.batch_size))
            if config.logs(frames):
                now = batch["observation"][:, :, -1]
                session.log({**losses, **diagnostics(now, network, config, frames)})
        return session.finish()


if __name__ == "__main__":
    sys.exit(launch(["train", "dqn", *sys.argv[1:]], fit=train))
