"""A check of a certified body against the meshes of the arm's maker: uncovered distance, slack, a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot.robots.bodies import Body
from splatbot.robots.containment import Slack, slack_of, uncovered_by_link
from splatbot.robots.maker_meshes import Source


@dataclass(frozen=True)
class PartCheck:
    """Result of one part.

    Args:
        part: its name.
        spheres: their number.
        uncovered: [m] upper bound of the distance of any mesh point from the spheres; 0 is a proof of containment.
        slack: distances of the spheres' outer surface from the meshes.
    """

    part: str
    spheres: int
    uncovered: float
    slack: Slack


def check_body(body: Body, source: Source) -> list[PartCheck]:
    """Prove containment of every triangle of the installed meshes, and measure the slack.

    Raises:
        InputError: the meshes are not installed.
    """
    found = []
    for part, spheres in body.parts.items():
        shapes = source.shapes(part)
        bound = max(uncovered_by_link(shapes, body.on(part, 0)).values())
        found.append(PartCheck(part, len(spheres), bound, slack_of(shapes, spheres[:, :3], spheres[:, 3])))
    return found


def draw_body(body: Body, source: Source, path: Path) -> None:
    """Write a picture: the corners of each part's meshes from two sides, with the outlines of its spheres [mm].

    Raises:
        InputError: the meshes are not installed.
    """
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(2.2 * len(body.parts), 5), layout="constrained")
    axes = figure.subplots(2, len(body.parts), squeeze=False)
    for column, (part, spheres) in enumerate(body.parts.items()):
        corners = 1e3 * np.concatenate([shape.triangles().reshape(-1, 3) for shape in source.shapes(part)])
        for row, (across, name) in enumerate(((0, "x"), (1, "y"))):
            axis = axes[row, column]
            axis.plot(corners[:, across], corners[:, 2], ",", color="0.35")
            outlines = [Circle((1e3 * s[across], 1e3 * s[2]), 1e3 * s[3]) for s in spheres]
            axis.add_collection(
                PatchCollection(outlines, facecolor=(0.1, 0.4, 0.8, 0.06), edgecolor=(0.1, 0.4, 0.8, 0.6))
            )
            axis.set_aspect("equal")
            axis.autoscale_view()
            axis.tick_params(labelsize=6)
            axis.set_xlabel(f"{name} [mm]", fontsize=7)
            axis.set_title(f"{part}: {len(spheres)}" if row == 0 else "", fontsize=8)
        axes[0, 0].set_ylabel("z [mm]", fontsize=7)
    figure.savefig(path, dpi=110)
