"""Seeded pairs of a table top before and after changes, with the truth of each change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision.changes import ChangedObject
from splatbot.collision.visibility import DepthView
from splatbot.frame import Frame
from splatbot.geometry import transform_points
from splatbot.logs.base import StampedLog
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.scenes.tabletop import TABLETOP_STAGE, tabletop
from splatbot.logs.shapes import TriangleMesh, box, cylinder, sphere
from splatbot.logs.textures import Texture
from splatbot.logs.trajectories import MotionOptions, make_path
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]
Places = list[tuple[str, Array]]

CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)
FLOOR, QUAD = 0.001, 0.002  # [m], [1/m] of the noise of depth
_SPOTS = [(x, y) for x in (-0.45, -0.25, 0.0, 0.22, 0.42) for y in (-0.25, -0.02, 0.24)]


@dataclass(frozen=True)
class ScenePair:
    """Two scenes of one table.

    Args:
        before, after: the scenes.
        places: "appeared" or "removed" and the centre (3,) [m, world] of each changed object; one that moved has both.
        moved: centres (3,) [m, world] before and after of the object that moved.
    """

    before: RaycastScene
    after: RaycastScene
    places: Places
    moved: tuple[Array, Array]


def scene_pair(seed: int) -> ScenePair:
    """Build a table with three objects that stay, two that appear, two that are removed and one that moves."""
    rng = np.random.default_rng(seed)
    spots = [np.array([*spot, 0.0]) for spot in rng.permutation(_SPOTS)]

    def placed(mesh: TriangleMesh, texture: Texture, spot: int) -> tuple[RaycastSurface, Array]:
        at = spots[spot] + [*rng.uniform(-0.02, 0.02, 2), 0.0]
        surface = RaycastSurface(mesh.placed(at, rng.uniform(0, 3)), texture)
        vertices = surface.mesh.vertices
        return surface, (vertices.min(axis=0) + vertices.max(axis=0)) / 2

    furniture = tabletop().surfaces[:4]
    before, after, places = list(furniture), list(furniture), []
    for number in range(7):
        surface, center = placed(*_solid(rng), number)
        if number < 5:
            after.append(surface)
        if number < 3 or number >= 5:
            before.append(surface)
        if number >= 3:
            places.append(("appeared" if number < 5 else "removed", center))
    solid = _solid(rng)
    (old, was), (new, now) = placed(*solid, 7), placed(*solid, 8)
    places += [("removed", was), ("appeared", now)]
    return ScenePair(RaycastScene([*before, old]), RaycastScene([*after, new]), places, (was, now))


def _solid(rng: np.random.Generator) -> tuple[TriangleMesh, Texture]:
    texture = Texture(tuple(rng.uniform(0.2, 0.95, 3)), tuple(rng.uniform(0.1, 0.6, 3)), seed=int(rng.integers(50)))
    kind = rng.integers(3)
    if kind == 0:
        return box(rng.uniform(0.05, 0.13, 3)), texture
    return (cylinder(rng.uniform(0.03, 0.05), rng.uniform(0.08, 0.15)) if kind == 1 else sphere(0.05)), texture


class SceneLog(StampedLog):
    """Noisy frames of a scene along a path, at 10 Hz.

    Args:
        scene: the scene.
        path: name of the path of the camera.
        seed: of the noise.
        start: [s] time on the path of the first frame.
        frames: number of frames.
    """

    camera = CAMERA

    def __init__(self, scene: RaycastScene, path: str, *, seed: int, start: float = 0.0, frames: int = 30) -> None:
        self.uri = self.name = f"changed-{seed}"
        self.scene, self.seed = scene, seed
        pose = make_path(path, TABLETOP_STAGE, MotionOptions(8.0, arc=np.radians(50.0), seed=seed))
        self.stamps = [0.1 * i for i in range(frames)]
        self.ground_truth = Trajectory(np.array(self.stamps), np.array([pose(start + t) for t in self.stamps]))

    def _decode(self, index: int) -> Frame:
        rgb, depth = self.scene.render(CAMERA, self.ground_truth.T_world_camera[index])
        noise = np.random.default_rng([self.seed, index]).normal(0.0, FLOOR + QUAD * depth**2)
        noisy = np.where(depth > 0, depth + noise, 0.0).astype(np.float32)
        return Frame(self.stamps[index], rgb, noisy, CAMERA, index)

    def views(self, step: int = 1) -> tuple[list[DepthView], list[NDArray[np.uint8]]]:
        """Return depth with exact poses, and colour, of every ``step``-th frame."""
        frames = [self[i] for i in range(0, len(self), step)]
        return [(f.depth, CAMERA, self.ground_truth.T_world_camera[f.index]) for f in frames], [f.rgb for f in frames]


def reported_places(changes: list[ChangedObject], T_world_a: Array | None = None) -> Places:
    """Return the places of changes in the world of the scene; an object that moved has two."""
    found: Places = []
    for change in changes:
        if change.previous is not None:
            found += [("appeared", change.center), ("removed", change.previous.center)]
        else:
            found.append((change.kind, change.center))
    T = np.eye(4) if T_world_a is None else T_world_a
    return [(kind, transform_points(T, center[None])[0]) for kind, center in found]


def matches(reported: Places, truth: Places, within: float = 0.05) -> int:
    """Count the reported places of the right kind within a distance [m] of a true one; each true one counts once."""
    left, count = list(truth), 0
    for kind, center in reported:
        near = [k for k, (name, at) in enumerate(left) if name == kind and np.linalg.norm(at - center) < within]
        if near:
            del left[near[0]]
            count += 1
    return count
