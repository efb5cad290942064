"""A check of a certified body against the meshes of the arm's maker: uncovered distance, slack, a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot.protocols import Array, LinkSpheres
from splatbot.robots.bodies import Body
from splatbot.robots.containment import Slack, slack_of, uncovered_by_link
from splatbot.robots.maker_meshes import Source
from splatbot.robots.robot import RobotModel
from splatbot.robots.shapes import Shape


@dataclass(frozen=True, eq=False)
class Part:
    """Shapes of one link, and the spheres (S, 4) that contain them: x, y, z, radius [m]."""

    shapes: Sequence[Shape]
    spheres: Array


def parts_of_body(body: Body, source: Source) -> dict[str, Part]:
    """Return the parts of a body with the installed meshes.

    Raises:
        InputError: the meshes are not installed.
    """
    return {name: Part(source.shapes(name), spheres) for name, spheres in body.parts.items()}


def parts_of_arm(shapes: Sequence[Shape], covering: LinkSpheres, robot: RobotModel) -> dict[str, Part]:
    """Return the links of an arm that have shapes; each is named after the joint that moves it."""
    names = ["base", *(joint.name for joint in robot.joints)]
    rows = np.c_[covering.centers, covering.radii]
    return {
        names[link]: Part([shape for shape in shapes if shape.link == link], rows[covering.link == link])
        for link in sorted({shape.link for shape in shapes})
    }


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


def check_parts(parts: Mapping[str, Part]) -> list[PartCheck]:
    """Prove containment of every triangle of the meshes, and measure the slack."""
    found = []
    for name, part in parts.items():
        centers, radii = part.spheres[:, :3], part.spheres[:, 3]
        spheres = LinkSpheres(np.full(len(radii), part.shapes[0].link, np.int32), centers, radii)
        bound = max(uncovered_by_link(part.shapes, spheres).values())
        found.append(PartCheck(name, len(radii), bound, slack_of(part.shapes, centers, radii)))
    return found


def draw_parts(parts: Mapping[str, Part], path: Path) -> None:
    """Write a picture: the corners of each part's meshes from two sides, with the outlines of its spheres [mm]."""
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(2.2 * len(parts), 5), layout="constrained")
    axes = figure.subplots(2, len(parts), squeeze=False)
    for column, (name, part) in enumerate(parts.items()):
        spheres = part.spheres
        corners = 1e3 * np.concatenate([shape.triangles().reshape(-1, 3) for shape in part.shapes])
        for row, (across, direction) in enumerate(((0, "x"), (1, "y"))):
            axis = axes[row, column]
            axis.plot(corners[:, across], corners[:, 2], ",", color="0.35")
            outlines = [Circle((1e3 * s[across], 1e3 * s[2]), 1e3 * s[3]) for s in spheres]
            axis.add_collection(
                PatchCollection(outlines, facecolor=(0.1, 0.4, 0.8, 0.06), edgecolor=(0.1, 0.4, 0.8, 0.6))
            )
            axis.set_aspect("equal")
            axis.autoscale_view()
            axis.tick_params(labelsize=6)
            axis.set_xlabel(f"{direction} [mm]", fontsize=7)
            axis.set_title(f"{name}: {len(spheres)}" if row == 0 else "", fontsize=8)
        axes[0, 0].set_ylabel("z [mm]", fontsize=7)
    figure.savefig(path, dpi=110)
