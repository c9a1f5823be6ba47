"""Train DQN on the drone's world and compare it with the paper: the same as `uavnav train dqn`.

    python recipes/dqn.py activation=sigmoid
    python recipes/dqn.py activation=relu n_seeds=4 total_frames=1e6 preset=vectorised device=cpu out=runs/mine
    python recipes/dqn.py -m activation=relu,leaky_relu,tanh,sigmoid

`python recipes/dqn.py --help` says what each key means.
"""

import sys

from uavnav.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["train", "dqn", *sys.argv[1:]]))
