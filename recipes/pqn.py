"""Train PQN to fly the drone and compare it with the paper: the same as `uavnav train pqn`.

    python recipes/pqn.py activation=tanh
    python recipes/pqn.py activation=relu n_seeds=4 total_frames=1e6 preset=paper device=cpu
    out=runs/mine python recipes/pqn.py -m activation=sigmoid,leaky_relu

`python recipes/pqn.py --help` says what each key means.
"""

import sys

from uavnav.__main__ import launch

if __name__ == "__main__":
    sys.exit(launch(["train", "pqn", *sys.argv[1:]]))
