"""Appearance of hands on other arms: Robotiq's 2F-85 with its levers. Pictures alone use it; no check does.

`python -m splatbot.robots.hand_appearance` makes the stored meshes from those of :mod:`splatbot.robots.sources`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.report.robot_drawing import DrawnPart
from splatbot.robots.hands import robotiq_2f85
from splatbot.robots.linkage import pose_links
from splatbot.robots.robot import RobotModel
from splatbot.robots.sources import SOURCES, LinkageSource
from splatbot.robots.urdf import UrdfReader, parse
from splatbot.robots.visual import STEP, simplify

_FILE = Path(__file__).parent / "bodies" / "2f85_appearance.npz"
_MOST_TRIANGLES = 500  # of a link
DARK = (0.30, 0.31, 0.33)


@dataclass(frozen=True, eq=False)
class LinkageMeshes:
    """Meshes of a gripper's links at N positions, in the frame of its flange with the fingers opening along y.

    Args:
        opening: (N,) distance between the pads [m].
        poses: (N, 4, 4) of each link.
        triangles: (T, 3, 3) of each link, in its own frame [m].
    """

    opening: Array
    poses: tuple[Array, ...]
    triangles: tuple[Array, ...]

    def at(self, opening: float) -> list[Array]:
        """Return the triangles (T, 3, 3) of each link at the stored position that is nearest to an opening [m]."""
        k = int(np.argmin(np.abs(self.opening - opening)))
        return [transform_points(T[k], each) for T, each in zip(self.poses, self.triangles, strict=True)]


def hand_parts(robot: RobotModel, opening: float | None) -> list[DrawnPart] | None:
    """Return the parts of a robot's hand with ``opening`` [m] between its pads; None without stored meshes of the hand.

    Raises:
        FormatError: the stored meshes are damaged.
    """
    hand = robotiq_2f85()
    if robot.gripper is None or robot.gripper.hand != hand.box:
        return None
    T_link_flange = robot.T_link_tcp @ inverse(hand.T_flange_tcp)
    pieces = _stored().at(2 * hand.stroke if opening is None else opening)
    return [DrawnPart(len(robot), transform_points(T_link_flange, each), DARK) for each in pieces]


@cache
def _stored() -> LinkageMeshes:
    try:
        with np.load(_FILE) as stored:
            links = range(len([name for name in stored.files if name.endswith("/faces")]))
            corners = [STEP * stored[f"{k}"].astype(np.float64) for k in links]
            return LinkageMeshes(
                stored["opening"].astype(np.float64),
                tuple(stored[f"{k}/poses"].astype(np.float64) for k in links),
                tuple(corners[k][stored[f"{k}/faces"]] for k in links),
            )
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise FormatError(f"holds no meshes ({error}).", file=_FILE, hint="install splatbot again") from error


def save_linkage(source: LinkageSource, path: Path) -> None:
    """Save the visual meshes of a gripper's links, simplified, with their poses.

    Raises:
        InputError: the meshes are not installed.
        FormatError: the URDF is damaged.
    """
    file = source.path(source.urdf)
    links = pose_links(UrdfReader(file, parse(file)))
    seen = UrdfReader(file, parse(file), kinds=("visual",))
    stored: dict[str, np.ndarray] = {"opening": links.opening.astype(np.float32)}
    shown = {link: seen.shapes(link, 0, np.eye(4)) for link in links.corners}
    for k, link in enumerate(link for link, shapes in shown.items() if shapes):
        corners = np.concatenate([named.shape.triangles() for named in shown[link]]).reshape(-1, 3)
        mesh = simplify(corners, np.arange(len(corners)).reshape(-1, 3), _MOST_TRIANGLES)
        stored[f"{k}"] = np.rint(np.asarray(mesh.vertices) / STEP).astype(np.int32)
        stored[f"{k}/faces"] = np.asarray(mesh.triangles).astype(np.uint16)
        stored[f"{k}/poses"] = links.at[link].astype(np.float32)
    with atomic_write(path) as handle:
        np.savez_compressed(handle, allow_pickle=False, **stored)


if __name__ == "__main__":
    found = SOURCES["2f85"]
    assert isinstance(found, LinkageSource)
    save_linkage(found, _FILE)
