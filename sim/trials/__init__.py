"""Simulated picking trials: seeded scenes, each scanned, mapped, and picked from by stacks that use only the scan."""
