"""Benchmarks, `python -m uavnav.bench`: jobs, peers, a NumPy world to measure against, and what was found."""
