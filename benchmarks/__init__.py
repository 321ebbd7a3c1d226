"""Benchmarks: one question a file, one JSON line a result."""
