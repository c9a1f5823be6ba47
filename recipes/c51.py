"""Train C51 to fly the drone and compare it with the paper: the same as `uavnav train c51`.

    python recipes/c51.py activation=relu preset=fast
    python recipes/c51.py activation=relu n_seeds=4 total_frames=1e6 preset=paper device=cpu
    out=runs/mine python recipes/c51.py -m activation=sigmoid,leaky_relu

`python recipes/c51.py --help` says what each key means.
"""

import sys

from uavnav.__main__ import launch

if __name__ == "__main__":
    sys.exit(launch(["train", "c51", *sys.argv[1:]]))
