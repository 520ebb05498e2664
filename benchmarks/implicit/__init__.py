"""Benchmarks of implicit steps."""
