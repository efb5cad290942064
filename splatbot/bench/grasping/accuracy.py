"""`splatbot bench grasping`: candidates a second, time to a ranked list, and grasps against the exact shapes."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.grasping import GraspingSettings
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Solid, Tabletop, tabletop
from splatbot.bench.timing import threads
from splatbot.grasping.affordance import Target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import GraspResult
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment

DEFAULT_SAMPLES = GraspOptions().samples
_STEP = 1e-5  # [m] of differences for the true normals


@dataclass(frozen=True, eq=False)
class _BenchObject:
    """A segmented object of the table top, and its exact shape."""

    target: Target
    solid: Solid


def run_grasping(settings: GraspingSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure all sizes of the map and all numbers of samples, on two threads."""
    report_progress("measuring the machine")
    results = Results(describe_machine((2,), peak_ms=settings.peak_ms))
    top = tabletop()
    with threads(2):
        for count in settings.gaussians:
            report_progress(f"{count} Gaussians")
            _run_map(results, top, count, DEFAULT_SAMPLES if not settings.quick else 100, f"{count} Gaussians")
            settings.save(results)
        for samples in settings.samples:
            report_progress(f"{samples} samples")
            name = f"{samples} samples" + (" (default)" if samples == DEFAULT_SAMPLES else "")
            _run_map(results, top, settings.gaussians[0], samples, name)
    return results


def _run_map(results: Results, top: Tabletop, count: int, samples: int, case: str) -> None:
    model = top.gaussians(count)
    start = time.perf_counter()
    scene = segment(model, np.eye(4))
    segmented = time.perf_counter() - start
    objects = _bench_objects(scene, top)
    sampler = GraspSampler(scene, panda())
    options = GraspOptions(samples=samples)
    sampler.sample(objects[0].target, options)  # warms up
    found: list[tuple[_BenchObject, GraspResult, float]] = []
    for one in objects:
        start = time.perf_counter()
        result = sampler.sample(one.target, options)
        found.append((one, result, time.perf_counter() - start))
    seconds = np.array([spent for _, _, spent in found])
    hands = sum(result.candidates for _, result, _ in found)
    results.add(case, "segmentation", 1e3 * segmented, "ms")
    results.add(case, "to a ranked list, median", 1e3 * float(np.median(seconds)), "ms")
    results.add(case, "to a ranked list, most", 1e3 * float(seconds.max()), "ms")
    results.add(case, "candidates", hands / float(seconds.sum()), "1/s")
    narrow = [f for f in found if _narrow(f[0].solid)]
    results.add(case, "graspable objects with a grasp", sum(bool(r) for _, r, _ in narrow), f"of {len(narrow)}")
    best = [result.grasps[0].total for _, result, _ in found if result]
    results.add(case, "score of the best, mean", float(np.mean(best)) if best else None, "")
    _audit(results, case, found)


def _bench_objects(scene: SegmentedMap, top: Tabletop) -> list[_BenchObject]:
    """Return the segmented objects whose shape is known, without the shelf."""
    points = scene.model.means.double().numpy()
    found = []
    for cluster in scene.objects:
        away = [float(np.median(np.abs(solid.distance(points[cluster.rows])))) for solid in top.solids[5:]]
        k = int(np.argmin(away))
        if away[k] < 2e-3:
            found.append(
                _BenchObject(
                    Target(cluster.rows, None, f"object {k}", "bench", 1.0, (), cluster.number), top.solids[5 + k]
                )
            )
    return found


def _narrow(solid: Solid) -> bool:
    """Return whether a hand of 8 cm, less its tolerance, encloses the solid."""
    size = getattr(solid, "size", None)
    return (min(size[:2]) if size is not None else 2 * solid.radius) < 0.074  # type: ignore[attr-defined]


def _audit(results: Results, case: str, found: list[tuple[_BenchObject, GraspResult, float]]) -> None:
    """Add the distances of contacts to the true surface, and the angles of true normals to their line."""
    off: list[float] = []
    angle: list[float] = []
    for one, result, _ in found:
        for grasp in result.grasps:
            off += np.abs(one.solid.distance(grasp.contacts)).tolist()
            line = grasp.contacts[1] - grasp.contacts[0]
            line = line / np.linalg.norm(line)
            normals = _normals(one.solid, grasp.contacts)
            angle += np.degrees(np.arccos(np.clip(normals @ line * [-1.0, 1.0], -1.0, 1.0))).tolist()
    results.add(case, "checked grasps", len(off) // 2, "")
    for name, values, unit, scale in (
        ("distance of contacts to the true surface", off, "mm", 1e3),
        ("angle of true normals to the contact line", angle, "deg", 1.0),
    ):
        for part, share in (("95 %", 95.0), ("most", 100.0)):
            value = scale * float(np.percentile(values, share)) if values else None
            results.add(case, f"{name}, {part}", value, unit)


def _normals(solid: Solid, points: Array) -> Array:
    steps = _STEP * np.eye(3)
    slope = np.stack([solid.distance(points + step) - solid.distance(points - step) for step in steps], axis=1)
    return np.asarray(slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12))
