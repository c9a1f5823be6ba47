"""Benchmarks, `uavnav bench`: sections of measurements, the peers, and a NumPy world to measure against."""
