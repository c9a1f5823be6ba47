"""Train any algorithm of the table, or of a plugin of your own, on the drone's world.

    python recipes/train.py algorithm=reinforce plugins=my_module n_seeds=4
    python recipes/train.py algorithm=ppo activation=relu task=drone world.sensor_arc=90

Every key is a field of the algorithm's configuration; `--cfg job` shows them all with their values.
"""

from launch import launch

if __name__ == "__main__":
    launch("train")
