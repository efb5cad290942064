"""Seeded scans of thin, transparent and black objects, and probes of their maps."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray

from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.thin import ThinSettings
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, evidence_at, find_unknown
from splatbot.collision.unknown import UnknownPolicy
from splatbot.collision.visibility import DepthView
from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.logs.raycast import Moving, RaycastScene, RaycastSurface
from splatbot.logs.shapes import TriangleMesh, box, cup, cylinder
from splatbot.logs.textures import Texture
from splatbot.mapping.completion import missing_gaussians
from splatbot.mapping.depth_fusion import DepthNoiseModel
from splatbot.mapping.keyframes import Keyframe, mapping_images
from splatbot.protocols import Array
from splatbot.sim.effects.registry import make_effects
from splatbot.tracking.features import Features
from splatbot.tracking.reference import Reference

POLICIES: tuple[UnknownPolicy, ...] = ("free", "cautious", "occupied")
EFFECTS = ("depth_noise", "stereo_holes:dark=40")


@dataclass(frozen=True)
class ThinConstants:
    """Constants of the scans.

    Args:
        probe: [m] radius of the probe.
        clear: [m] a free probe is at least this far from every shape.
        points: number of probes on an object, and of free probes in a scan.
        voxel: [m] voxels of unknown space.
        glass_seen: share of the pixels of glass that show the depth behind it.
    """

    probe: float = 0.008
    clear: float = 0.03
    points: int = 400
    voxel: float = 0.01
    glass_seen: float = 0.2


CONSTANTS = ThinConstants()

BOX = np.array([[-0.35, -0.3, 0.0], [0.35, 0.3, 0.3]])
_GRAY, _BLACK, _GLASS = Texture((0.6, 0.6, 0.65), (0.4, 0.4, 0.45)), (0.02, 0.02, 0.02), (0.7, 0.8, 0.8)
_CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)


@dataclass(frozen=True, eq=False)
class ThinScan:
    """A scan: the true scene, the meshes by kind, and the depth that a camera measures.

    Args:
        scene: true shapes; the glass exists before the time 1 s.
        kinds: meshes of each kind of object.
        views: measured depth, camera and pose of each view.
        frames: frames of the views.
    """

    scene: RaycastScene
    kinds: dict[str, list[TriangleMesh]]
    views: list[DepthView]
    frames: list[Frame]


def run_scans(settings: ThinSettings, report_progress: ReportProgress) -> Results:
    """Count missed probes by kind and policy, and hits in free space by policy."""
    missed: dict[tuple[str, UnknownPolicy], list[NDArray[np.bool_]]] = defaultdict(list)
    for number in range(settings.scans):
        report_progress(f"scan {number + 1} of {settings.scans}")
        scan = make_scan(settings.seed + number, settings.views)
        fields = fields_of(scan)
        free = free_probes(scan, settings.seed + number)
        for kind, meshes in scan.kinds.items():
            probes = surface_probes(scan, meshes, settings.seed + number)
            for policy, field in fields.items():
                missed[kind, policy].append(~field.in_collision(probes))
        for policy, field in fields.items():
            missed["free space", policy].append(field.in_collision(free))
    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    for (kind, policy), parts in missed.items():
        found = np.concatenate(parts)
        metric = "false hits" if kind == "free space" else "missed"
        share = 100.0 * float(found.mean()) if len(found) else 0.0
        results.add(f"{kind}, unknown={policy}", metric, share, f"% of {len(found)}")
    return results


def make_scan(seed: int, views: int) -> ThinScan:
    """Build the scan of a seed: shapes, exact poses on an arc, and depth with the errors of a stereo camera."""
    rng = np.random.default_rng(seed)
    kinds = _objects(rng)
    table = RaycastSurface(
        box([1.6, 1.2, 0.04]).placed([0, 0, -0.04]), Texture((0.80, 0.62, 0.42), (0.45, 0.30, 0.18), 0.04)
    )
    surfaces = {kind: [RaycastSurface(mesh, _texture(kind)) for mesh in meshes] for kind, meshes in kinds.items()}
    glass = surfaces.pop("glass")
    solid = [surface for parts in surfaces.values() for surface in parts]
    scene = RaycastScene([table, *solid], {"glass": Moving(glass, lambda t: np.eye(4) if t < 1.0 else None)})
    effects = make_effects(EFFECTS, seed=seed)
    frames, measured = [], []
    for k, angle in enumerate(np.linspace(-1.2, 1.2, views)):
        T = _looking_at(np.array([0.65 * np.sin(angle), -0.65 * np.cos(angle), rng.uniform(0.3, 0.6)]))
        rgb, depth = scene.render(_CAMERA, T, 0.0)
        behind = scene.render(_CAMERA, T, 2.0)[1]
        seen = rng.random(depth.shape) < CONSTANTS.glass_seen
        depth = np.where(scene.moving_mask(_CAMERA, T, 0.0), np.where(seen, behind, np.float32(0)), depth)
        frame = effects(Frame(float(k), rgb, depth.astype(np.float32), _CAMERA, k))
        frames.append(frame)
        measured.append((frame.depth, _CAMERA, T))
    return ThinScan(scene, kinds, measured, frames)


def fields_of(scan: ThinScan) -> dict[UnknownPolicy, GaussianCollisionField]:
    """Map the scan at its exact poses by completion alone, and add unknown space under each policy."""
    config = Config()
    keyframes = []
    for k, (frame, (_, _, T)) in enumerate(zip(scan.frames, scan.views, strict=True)):
        camera, rgb, depth = mapping_images(frame, config.mapping, config.tracking)
        images = (torch.from_numpy(np.ascontiguousarray(rgb)), torch.from_numpy(depth))
        keyframes.append(Keyframe(k, camera, *images, T, Features.none(), Reference(T, ())))
    noise = DepthNoiseModel.of(config.tracking)
    model = missing_gaussians(GaussianModel.empty(), keyframes, config.mapping, noise)
    space = find_unknown(BOX, CONSTANTS.voxel, scan.views)
    return {
        policy: GaussianCollisionField(GaussianModel.concatenate([model, space.solids(policy=policy, rim=False)]))
        for policy in POLICIES
    }


def surface_probes(scan: ThinScan, meshes: list[TriangleMesh], seed: int) -> Array:
    """Return probes (P, 4) on the surface of meshes, at points that at least two views see."""
    points = np.concatenate([_sampled(mesh, CONSTANTS.points // len(meshes), seed) for mesh in meshes])
    seen = np.zeros(len(points), np.int32)
    for _, camera, T in scan.views:
        p = transform_points(inverse(T), points)
        u, v = camera.fx * p[:, 0] / p[:, 2] + camera.cx, camera.fy * p[:, 1] / p[:, 2] + camera.cy
        inside = (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
        seen += inside & (scan.scene.reach(T[:3, 3], points - T[:3, 3]) > 1.0 - 1e-3)
    chosen = points[(seen >= 2) & ((points > BOX[0]) & (points < BOX[1])).all(axis=1)]
    return np.c_[chosen, np.full(len(chosen), CONSTANTS.probe)]


def free_probes(scan: ThinScan, seed: int) -> Array:
    """Return probes (P, 4) far from every shape, at points that three views saw through."""
    points = np.random.default_rng(seed).uniform(BOX[0], BOX[1], (CONSTANTS.points * 3, 3))
    shapes = o3d.t.geometry.RaycastingScene()
    for mesh in [surface.mesh for surface in scan.scene.surfaces] + scan.kinds["glass"]:
        shapes.add_triangles(_tensor(mesh.vertices.astype(np.float32)), _tensor(mesh.triangles))
    distance = shapes.compute_distance(_tensor(points.astype(np.float32))).numpy()
    evidence = evidence_at(points, scan.views)
    chosen = points[(distance > CONSTANTS.clear) & (evidence.passes >= 3) & (evidence.hits == 0)][: CONSTANTS.points]
    return np.c_[chosen, np.full(len(chosen), CONSTANTS.probe)]


def _objects(rng: np.random.Generator) -> dict[str, list[TriangleMesh]]:
    """Return one object of each kind, at shuffled places on the table."""
    places = rng.permutation(np.array([[-0.22, 0.1], [0.0, 0.12], [0.22, 0.1], [-0.12, -0.1], [0.12, -0.1]]))
    places = np.c_[places, np.zeros(5)]
    rods = []
    for shift, radius in zip((-0.03, 0.0, 0.03), rng.uniform(0.001, 0.005, 3), strict=True):
        foot = places[0] + np.array([shift, 0.0, 0.0])
        rods.append(_rod(foot, foot + np.array([0.0, rng.uniform(-0.06, 0.06), rng.uniform(0.1, 0.2)]), radius))
    turns = np.linspace(0.0, 1.0, 9)
    rope = places[1] + np.c_[0.12 * (turns - 0.5), 0.04 * np.sin(6 * turns), 0.01 + 0.12 * (2 * turns - 1) ** 2]
    cable = [_rod(a, b, rng.uniform(0.0015, 0.004)) for a, b in pairwise(rope)]
    wires = _basket(places[2], rng.uniform(0.001, 0.002))
    glass = [cup(0.03, 0.12, 0.003).placed(places[3])]
    black = [
        cylinder(rng.uniform(0.015, 0.03), 0.1).placed(places[4]),
        _rod(places[4] + [0.05, 0, 0.002], places[4] + [0.05, 0.1, 0.002], 0.003),
    ]
    return {"rods": rods, "cable": cable, "wire basket": wires, "glass": glass, "black": black}


def _basket(at: Array, radius: float) -> list[TriangleMesh]:
    x, y, height = 0.06, 0.05, 0.09
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    rings = [corners + at + [0, 0, h] for h in (0.005, height / 2, height)]
    wires = [_rod(ring[k], ring[(k + 1) % 4], radius) for ring in rings for k in range(4)]
    for k in range(4):
        for share in (0.0, 0.33, 0.67):
            foot = (1 - share) * corners[k] + share * corners[(k + 1) % 4] + at
            wires.append(_rod(foot, foot + np.array([0, 0, height]), radius))
    return wires


def _rod(start: Array, end: Array, radius: float) -> TriangleMesh:
    """Build a closed cylinder between two points [m]."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    z = axis / length
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    mesh = cylinder(radius, length)
    return replace(mesh, vertices=mesh.vertices @ np.stack([x, np.cross(z, x), z]) + start)


def _texture(kind: str) -> Texture:
    if kind == "black":
        return Texture(_BLACK, _BLACK, kind="plain")
    return Texture(_GLASS, _GLASS, kind="plain") if kind == "glass" else _GRAY


def _looking_at(eye: Array) -> Array:
    """Return T_world_camera (4, 4) of a camera at ``eye`` that looks at the middle of the table."""
    z = np.array([0.0, 0.0, 0.05]) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return T


def _sampled(mesh: TriangleMesh, count: int, seed: int) -> Array:
    """Sample points (count, 3) uniformly on a mesh."""
    rng = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    s, t = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    return np.asarray((1 - s) * a[chosen] + s * (1 - t) * b[chosen] + s * t * c[chosen])


def _tensor(values: NDArray[np.float32] | NDArray[np.uint32]) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values))
