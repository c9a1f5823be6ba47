"""Tasks as pure functions over batches: constants, obstacles, motion, sensing, rewards; scripted policies."""
