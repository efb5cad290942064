"""Picking trials: seeded scenes, each scanned, mapped, and picked from by stacks that know nothing but the scan."""
