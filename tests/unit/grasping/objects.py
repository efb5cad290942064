"""A table with objects of exact shape as Gaussians."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from splatbot.bench.tabletop import Ball, Block, Can, Solid, Tabletop
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import shortest_axes
from splatbot.grasping.affordance import Target
from splatbot.segmentation import SegmentedMap, segment
from splatbot.workspace import NamedPlace

TABLE = Block((0.5, 0.0, -0.02), (0.7, 0.9, 0.04))
BOX = Block((0.45, 0.10, 0.06), (0.10, 0.06, 0.12), 0.4)
CAN = Can((0.50, -0.15, 0.0), 0.03, 0.12)
BALL = Ball((0.60, 0.25, 0.035), 0.035)
BIG = Block((0.65, -0.32, 0.10), (0.12, 0.12, 0.20))
OBJECTS: dict[str, Solid] = {"box": BOX, "can": CAN, "ball": BALL, "big": BIG}
COLORS = {"box": (0.8, 0.1, 0.1), "can": (0.1, 0.2, 0.8), "ball": (0.9, 0.8, 0.1), "big": (0.1, 0.6, 0.2)}


def colored(solids: dict[str, Solid], count: int, colors: dict[str, tuple[float, float, float]]) -> GaussianModel:
    """Return a table and solids as about ``count`` Gaussians, each solid in its colour."""
    model = Tabletop((TABLE, *solids.values())).gaussians(count)
    means = model.means.double().numpy()
    rgb = np.full((len(means), 3), 0.6)
    for name, solid in solids.items():
        rgb[(np.abs(solid.distance(means)) < 1e-4) & (means[:, 2] > 1e-3)] = colors.get(name, (0.5, 0.5, 0.5))
    return GaussianModel.from_activated(
        means=model.means, quats=model.quats, scales=model.scales, opacities=model.opacities, colors=rgb
    )


@cache
def model() -> GaussianModel:
    """Return the Gaussians of the table with all objects."""
    return colored(OBJECTS, 24_000, COLORS)


@cache
def scene() -> SegmentedMap:
    """Return the segmented map, in which the can has a name."""
    return segment(model(), np.eye(4), names=(NamedPlace("soup", np.array([0.50, -0.15, 0.12]), ("tin of soup",)),))


def seen_from_above(full: GaussianModel) -> GaussianModel:
    """Remove the Gaussians that face sideways or down."""
    up = np.abs(shortest_axes(full)[:, 2].numpy()) > 0.7
    return full.select(torch.from_numpy(np.flatnonzero(up & (full.means[:, 2].numpy() > -0.01))))


def target_of(found: SegmentedMap, solid: Solid, name: str) -> Target:
    """Return the object whose Gaussians are on the solid."""
    points = found.model.means.double().numpy()
    distances = [float(np.median(np.abs(solid.distance(points[o.rows])))) for o in found.objects]
    k = int(np.argmin(distances))
    assert distances[k] < 3e-3, distances
    return Target(found.objects[k].rows, None, name, "test", 1.0, (), k)
