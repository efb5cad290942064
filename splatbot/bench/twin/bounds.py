"""Bounds of the values of `splatbot bench twin`."""

from __future__ import annotations

from splatbot.bench.results import Results

FORCED = "empty scene, contact and drag forced on"
EXACT = "composite picture, exact map"
FILMED = "composite picture, map of a noisy film"

# Case, metric, least and largest.
_BOUNDS: tuple[tuple[str, str, float, float], ...] = (
    ("empty scene", "over the robot alone", 0.0, 1.3),
    (FORCED, "over none forced", 1.2, float("inf")),  # physics that cannot apply is not free
    ("planned paths among the true shapes", "in contact", 0.0, 0.0),
    (EXACT, "median overlap", 0.98, 1.0),
    (EXACT, "farthest wrong pixel", 0.0, 4.0),  # outlines are soft
    (FILMED, "least overlap", 0.98, 1.0),
    (FILMED, "PSNR lost, most", float("-inf"), 0.1),
)


def broken_bounds(results: Results) -> list[str]:
    """Return a sentence for each value out of its bounds; values that were not measured are skipped."""
    found = []
    for case, metric, least, largest in _BOUNDS:
        value = results.find(case, metric)
        if value is not None and not least <= value <= largest:
            found.append(f"{case}: {metric} is {value:.3g}, not in {least:g}..{largest:g}")
    return found
