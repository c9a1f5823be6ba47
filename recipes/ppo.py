"""Train PPO on the drone's world and compare it with the paper: the same as `uavnav train ppo`.

    python recipes/ppo.py activation=relu
    python recipes/ppo.py activation=relu n_seeds=4 total_frames=1e6 preset=vectorised device=cpu out=runs/mine
    python recipes/ppo.py -m activation=relu,leaky_relu,tanh,sigmoid

`python recipes/ppo.py --help` says what each key means.
"""

import sys

from uavnav.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["train", "ppo", *sys.argv[1:]]))
