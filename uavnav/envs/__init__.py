"""The environment's shells: TorchRL, Gymnasium, Stable-Baselines3, and one state as a picture."""
