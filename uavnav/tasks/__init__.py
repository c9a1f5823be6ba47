"""The paper's world as pure functions over batches: constants, obstacles, motion, sensing, rewards."""
