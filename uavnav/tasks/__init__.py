"""The tasks as pure functions over batches: constants, obstacles, motion, sensing, rewards, scripts."""
