"""Train A2C on the drone's world and see what it reaches beside the paper's two.

    python recipes/a2c.py activation=relu
    python recipes/a2c.py activation=tanh n_seeds=4 total_frames=1e6 preset=paper device=cpu out=runs/mine
    python recipes/a2c.py -m activation=relu,leaky_relu,tanh,sigmoid

Every key is a field of uavnav.a2c.A2CConfig; `--cfg job` shows them all with their values.
"""

from launch import launch

if __name__ == "__main__":
    launch("a2c")
