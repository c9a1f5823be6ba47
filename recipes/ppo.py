"""Train PPO on the drone's world and compare it with the paper.

    python recipes/ppo.py activation=relu
    python recipes/ppo.py activation=tanh n_seeds=4 total_frames=1e6 preset=paper device=cpu out=runs/mine
    python recipes/ppo.py -m activation=relu,leaky_relu,tanh,sigmoid

Every key is a field of uavnav.ppo.PPOConfig; `--cfg job` shows them all with their values.
"""

from launch import launch

if __name__ == "__main__":
    launch("ppo")
