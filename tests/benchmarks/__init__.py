"""Benchmarks: scripts that first show that the answer is right, then time."""
