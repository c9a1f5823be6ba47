"""What every algorithm trains with: configuration, recorder, snapshots, processes, learner."""
