"""Accuracy, stability and speed of torch_mpm, measured; `python -m benchmarks` runs all of it."""
