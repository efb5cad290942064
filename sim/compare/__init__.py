"""How far the twin is from what it stands for: from a recorded log (sim-to-real), from a held-out twin (sim-to-sim)."""
