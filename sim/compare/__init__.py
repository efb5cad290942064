"""Comparison of the twin with a recorded log (sim-to-real) and with a held-out twin (sim-to-sim)."""
