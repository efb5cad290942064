"""Grasps of objects that were scanned from one side, against their true shapes: which fingers would be in them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.grasping import GraspingSettings
from splatbot.bench.grasping.scenes import over_scenes
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import Hands
from splatbot.grasping.measured import CONSTANTS as MEASURED
from splatbot.grasping.measured import hand_penetration
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array, HandShape
from splatbot.sim.scene import SceneObject
from splatbot.sim.trials.scan import UnseenError, scan_scene
from splatbot.sim.trials.scenes import ScanViews, make_trial
from splatbot.sim.trials.stacks import GaussianStack
from splatbot.sim.trials.surfaces import surfaces_of

_ARCS = ((-110, -60), (-70, -20), (-25, 25), (20, 70), (60, 110))  # [deg] azimuths of a scan, by the scene's seed
_SPACING = 1e-3  # [m] of the points on true shapes
_SAME = 0.01  # [m] from a measured contact to the true shape that it belongs to
_DEEP = 0.003  # [m] of the true shape in a finger
_EDGES = (0.0, 0.001, 0.1, 0.2, 0.4, 0.7, 1.0)  # of the bins of unseen shares


@dataclass(frozen=True)
class OneSidedContact:
    """A contact of a grasp whose target was seen from one side.

    Args:
        away: distance of the contact from measured depth [m].
        unseen: share of its finger's inner face that no frame saw to be free, 0..1.
        depth: depth of the true shape in that finger before it closes [m]; see
            :func:`splatbot.grasping.measured.hand_penetration`.
        offered: whether the grasp is offered.
    """

    away: float
    unseen: float
    depth: float
    offered: bool


def run_one_sided(settings: GraspingSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Scan scenes over an azimuth of 50 degrees, and compare the fingers of all grasps with the true shapes."""
    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    seeds = range(settings.first, settings.first + settings.one_sided)
    contacts = over_scenes(seeds, _contacts, "contacts", report_progress)
    near = [contact for contact in contacts if contact.away <= MEASURED.unseen_from]
    far = [contact for contact in contacts if contact.away > MEASURED.unseen_from]
    _add(results, "one side / offered grasps", [contact for contact in contacts if contact.offered])
    _add(results, "one side / doubtful grasps", [contact for contact in contacts if not contact.offered])
    _add(results, "one side / contacts within 6 mm of depth", near)
    for low, high in pairwise(_EDGES):
        chosen = [c for c in far if low <= c.unseen < high or c.unseen == high == 1.0]
        _add(results, f"one side / farther contacts, {low:g} to {high:g} unseen", chosen)
    return results


def _add(results: Results, case: str, contacts: list[OneSidedContact]) -> None:
    results.add(case, "contacts", len(contacts), "")
    if contacts:
        depth = np.array([contact.depth for contact in contacts])
        results.add(case, "true shape over 3 mm in the finger", float((depth > _DEEP).mean()), "")
        results.add(case, "deepest", 1e3 * max(float(depth.max()), 0.0), "mm")


def _contacts(seed: int) -> list[OneSidedContact]:
    trial = make_trial(seed, "tabletop")
    low, high = _ARCS[seed % len(_ARCS)]
    middle = (low + high) // 2
    views = ScanViews(((40.0, (low, middle, high)), (50.0, (high, middle, low))))
    try:
        scan = scan_scene(trial, frames=24, viewpoints=views)
    except UnseenError:
        return []
    sampler = GaussianStack().sampler(scan, hand_only=True)
    shapes = [_surface(obj) for obj in trial.scene.objects if obj.movable]
    trees = [cKDTree(points) for points in shapes]
    T_base_world = inverse(scan.T_world_base)
    contacts: list[OneSidedContact] = []
    for item in sampler.scene.objects:
        target = Target(item.rows, None, f"object {item.number}", "bench", 1.0, (), item.number)
        result = sampler.sample(target, GraspOptions(samples=200))
        for grasp in (*result.grasps, *result.doubtful):
            assert grasp.depth_distance is not None
            measured = transform_points(T_base_world, grasp.contacts[int(np.argmin(grasp.depth_distance))])
            gaps = [float(tree.query(measured)[0]) for tree in trees]
            if min(gaps) <= _SAME:
                points = transform_points(inverse(T_base_world @ grasp.T_world_tcp), shapes[int(np.argmin(gaps))])
                contacts += _judged(grasp, points, sampler.hand)
    return contacts


def _judged(grasp: Grasp, points: Array, hand: HandShape) -> list[OneSidedContact]:
    """Compare both fingers of a grasp with points (P, 3) of the true shape in the tool's frame [m]."""
    assert grasp.depth_distance is not None
    assert grasp.unseen is not None
    beside = points[points[:, 2] > -hand.palm]  # the palm is not judged
    at = Hands.one(np.eye(4), grasp.opening)
    found = []
    for side, away, unseen in zip((-1.0, 1.0), grasp.depth_distance, grasp.unseen, strict=True):
        depth = hand_penetration(at, beside[side * beside[:, 1] > 0.0], hand, retreat=0.0)[0]
        found.append(OneSidedContact(float(away), float(unseen), float(depth), not grasp.rejected))
    return found


def _surface(item: SceneObject) -> Array:
    """Return points (P, 3) [m, scene] on an object's surface."""
    found = []
    for surface in surfaces_of(item):
        mesh = surface.mesh
        solid = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
        )
        count = max(1, round(solid.get_surface_area() / _SPACING**2))
        found.append(np.asarray(solid.sample_points_uniformly(count).points))
    return np.concatenate(found)
