"""Benchmarks: one file a question, run as ``python -m benchmarks.render``."""
