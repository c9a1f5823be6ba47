"""Train DQN on the drone's world and compare it with the paper.

    python recipes/dqn.py activation=sigmoid
    python recipes/dqn.py activation=relu n_seeds=4 total_frames=1e6 preset=paper-2.3 device=cpu out=runs/mine
    python recipes/dqn.py -m activation=relu,leaky_relu,tanh,sigmoid

Every key is a field of uavnav.dqn.DQNConfig; `--cfg job` shows them all with their values.
"""

from launch import launch

if __name__ == "__main__":
    launch("dqn")
