"""Benchmarks: each file answers one question and prints one JSON line per result."""
