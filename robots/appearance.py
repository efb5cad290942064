"""Appearance of arms in pictures: triangles of links and fingers with their colours.

The Panda's are Franka's visual meshes (Apache-2.0), simplified. Other arms show the visual meshes of their description,
which are stored with them, and hands the shapes of the twin. A link without these shows its certified spheres. Pictures
alone use them; no check does.

`python -m splatbot.robots.appearance` makes the stored meshes from those of :mod:`splatbot.robots.maker_meshes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError
from splatbot.geometry import transform_points
from splatbot.protocols import Array
from splatbot.report.robot_drawing import Color, DrawnPart
from splatbot.robots.hand_appearance import DARK, hand_parts
from splatbot.robots.maker_meshes import Source
from splatbot.robots.panda import T_LINK_HAND, panda
from splatbot.robots.robot import RobotModel
from splatbot.robots.visual import MOST_TRIANGLES, STEP, simplify

_FILE = Path(__file__).parent / "bodies" / "panda_appearance.npz"
_LIGHT = (0.90, 0.90, 0.91)
_GREY = (200, 200, 200)  # of a mesh without a material


def appearance(robot: RobotModel, opening: float | None = None) -> list[DrawnPart]:
    """Return the parts of a robot with ``opening`` [m] between its fingers; None opens them fully.

    Raises:
        FormatError: the stored meshes are damaged.
    """
    parts, fingers = links_and_finger(robot)
    hand = hand_parts(robot, opening)
    if hand is not None:
        before = [part for part in parts if part.link < len(robot)]
        return [*before, *(part for part in _link_meshes(robot) if part.link == len(robot)), *hand]
    return parts + [part for piece in fingers for part in _fingers(robot, piece.triangles, piece.color, opening)]


def links_and_finger(robot: RobotModel) -> tuple[list[DrawnPart], list[DrawnPart]]:
    """Return the parts of a robot's links, and those of one finger in its own frame.

    Raises:
        FormatError: the stored meshes are damaged.
    """
    last, parts = len(robot), _link_meshes(robot)
    if robot.shapes is panda().shapes:
        meshes = _panda_meshes()
        parts += [
            replace(piece, link=last, triangles=transform_points(T_LINK_HAND, piece.triangles))
            for piece in meshes["hand"]
        ]
        return parts, meshes["finger"]
    arm = {part.link for part in parts}
    parts += [
        DrawnPart(shape.link, shape.triangles(), DARK) for shape in robot.shapes if shape.link not in arm - {last}
    ]
    fingers: list[DrawnPart] = []
    if robot.gripper is not None and robot.gripper.shapes:
        fingers = [DrawnPart(0, np.concatenate([shape.triangles() for shape in robot.gripper.shapes]), DARK)]
    drawn, spheres = {part.link for part in parts} | ({last} if fingers else set()), robot.spheres()
    balls = [
        DrawnPart(int(link), np.asarray(center + radius * _ball()), _LIGHT)
        for link, center, radius in zip(spheres.link, spheres.centers, spheres.radii, strict=True)
        if link not in drawn
    ]
    return parts + balls, fingers


def _link_meshes(robot: RobotModel) -> list[DrawnPart]:
    """Return the visual meshes of the links, without hands."""
    meshes = _panda_meshes() if _has_panda_arm(robot) else {}
    stored = [replace(piece, link=k) for k in range(len(robot) + 1) for piece in meshes.get(f"link{k}", ())]
    return stored + [DrawnPart(mesh.link, mesh.triangles(), _LIGHT) for mesh in robot.visual]


def coarse_appearance(robot: RobotModel, most: int = 250) -> list[DrawnPart]:
    """Return :func:`appearance` with at most about ``most`` triangles for each link and colour, for pages that move."""
    found = []
    for part in merged(appearance(robot)):
        corners = part.triangles.reshape(-1, 3)
        mesh = simplify(corners, np.arange(len(corners)).reshape(-1, 3), most)
        found.append(replace(part, triangles=np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]))
    return found


def merged(parts: Sequence[DrawnPart]) -> list[DrawnPart]:
    """Join the parts of a link that have the same colour."""
    groups: dict[tuple[int, Color], list[Array]] = {}
    for part in parts:
        groups.setdefault((part.link, part.color), []).append(part.triangles)
    return [DrawnPart(link, np.concatenate(triangles), color) for (link, color), triangles in groups.items()]


def _has_panda_arm(robot: RobotModel) -> bool:
    """Return whether origins and axes of joints are those of the Panda; a name alone could be that of another arm."""
    own = panda().joints
    return len(robot) == len(own) and all(
        np.array_equal(a.T_before_joint[:, 2:], b.T_before_joint[:, 2:]) for a, b in zip(robot.joints, own, strict=True)
    )


def _fingers(robot: RobotModel, triangles: Array, color: Color, opening: float | None) -> list[DrawnPart]:
    """Return both fingers in the frame of the last link, from the triangles of one in its own frame."""
    assert robot.gripper is not None
    aside = robot.gripper.stroke if opening is None else opening / 2
    moved = triangles + np.array([0.0, aside, 0.0])
    return [DrawnPart(len(robot), transform_points(T, moved), color) for T in robot.gripper.T_link_finger]


@cache
def _ball() -> Array:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_icosahedron()
    mesh = mesh.subdivide_loop(2)
    corners = np.asarray(mesh.vertices)
    corners = corners / np.linalg.norm(corners, axis=1, keepdims=True)
    return np.asarray(corners[np.asarray(mesh.triangles)])


@cache
def _panda_meshes() -> dict[str, list[DrawnPart]]:
    """Return the pieces of each part of the Panda in its own frame; their link is 0."""
    found: dict[str, list[DrawnPart]] = {}
    try:
        with np.load(_FILE) as stored:
            for name in stored.files:
                if name.count("/") == 1:
                    triangles = STEP * stored[name].astype(np.float64)[stored[f"{name}/faces"]]
                    red, green, blue = (float(value) / 255 for value in stored[f"{name}/color"])
                    found.setdefault(name.split("/")[0], []).append(DrawnPart(0, triangles, (red, green, blue)))
    except (OSError, ValueError, KeyError) as error:
        raise FormatError(f"holds no meshes ({error}).", file=_FILE, hint="install splatbot again") from error
    return found


def save_appearance(source: Source, path: Path) -> None:
    """Save the visual meshes of a source, simplified by quadric decimation (Garland and Heckbert 1997).

    Faces of one colour are simplified together.

    Raises:
        InputError: the meshes are not installed.
    """
    stored = {}
    for part, files in source.parts.items():
        scene = trimesh.load_scene(source.path(files[0]), process=False)
        unit = trimesh.units.unit_conversion(scene.units, "meters") if scene.units else 1.0
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh)]
        total = sum(len(piece.faces) for piece in pieces)
        by_color: dict[tuple[int, ...], list[trimesh.Trimesh]] = {}
        for piece in pieces:
            diffuse = np.asarray(getattr(getattr(piece.visual, "material", None), "main_color", _GREY))[:3]
            by_color.setdefault(tuple(int(value) for value in diffuse), []).append(piece)
        for k, (color, same) in enumerate(by_color.items()):
            joined = trimesh.util.concatenate(same)
            assert isinstance(joined, trimesh.Trimesh)
            most = max(60, MOST_TRIANGLES * len(joined.faces) // total)
            mesh = simplify(unit * joined.vertices, joined.faces, most)
            name = f"{part}/{k}"
            stored[name] = np.rint(np.asarray(mesh.vertices) / STEP).astype(np.int32)
            stored[f"{name}/faces"] = np.asarray(mesh.triangles).astype(np.uint16)
            stored[f"{name}/color"] = np.array(color, np.uint8)
    with atomic_write(path) as file:
        np.savez_compressed(file, allow_pickle=False, **stored)


if __name__ == "__main__":
    from splatbot.robots.sources import SOURCES

    save_appearance(SOURCES["panda"], _FILE)
