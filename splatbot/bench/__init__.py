"""Benchmarks (`splatbot bench`): speed, and accuracy over time."""
