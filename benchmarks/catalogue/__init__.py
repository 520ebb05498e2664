"""Laws and scenes that tests and benchmarks have in common."""
