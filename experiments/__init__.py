"""Experiments whose result decided a design; run from a checkout as `python -m experiments.NAME`."""
