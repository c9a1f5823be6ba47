"""Train A2C to fly the drone and compare it with the paper: the same as `uavnav train a2c`.

    python recipes/a2c.py activation=tanh
    python recipes/a2c.py activation=relu n_seeds=4 total_frames=1e6 preset=paper device=cpu
    out=runs/mine python recipes/a2c.py -m activation=sigmoid,leaky_relu

`python recipes/a2c.py --help` says what each key means.
"""

import sys

from uavnav.__main__ import launch

if __name__ == "__main__":
    sys.exit(launch(["train", "a2c", *sys.argv[1:]]))
