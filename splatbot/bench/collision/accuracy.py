"""Measurements of `splatbot bench collision`: speed, memory and errors of the collision field."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.collision import CollisionSettings
from splatbot.bench.collision.mapped_log import audit_mapped_log
from splatbot.bench.collision.peers import mesh_of, run_brute_force, run_mesh_peers
from splatbot.bench.collision.recorded_run import audit_run
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Tabletop, tabletop
from splatbot.bench.timing import Timing, measure, threads
from splatbot.bench.truth import Audit, Truth, audit, score, without_self_collision
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres, gather_evidence
from splatbot.collision.robot import EPS
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.protocols import Array
from splatbot.robots.panda import panda

SWEEP = "sweep"


def run_collision(settings: CollisionSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure speed, errors, floaters, mapped logs and peers of the settings."""
    report_progress("measuring the machine")
    results = Results(describe_machine(settings.threads, peak_ms=settings.peak_ms))
    scene, arm = tabletop(), RobotSpheres(panda())
    rng = np.random.default_rng(0)
    q = panda().random(settings.configurations, rng)
    for count in settings.counts:
        model = scene.gaussians(count)
        for n in settings.threads:
            case = f"{count} Gaussians, {n} thread{'s' if n > 1 else ''}"
            report_progress(case)
            with threads(n):
                run_speed(settings, results, case, model, arm, q)
                if count == settings.reference:
                    run_speed(settings, results, f"{case}, packed", model, arm, q, packed=True)
        settings.save(results)
    parts: list[tuple[str, Callable[[], None]]] = [
        ("errors against exact truth", lambda: run_errors(settings, results, scene, arm)),
        ("floaters", lambda: run_floaters(settings, results, scene, arm)),
    ]
    frames, width, count = (3, 80, 200) if settings.quick else (30, 320, 50_000)
    sigmas = (2.0,) if settings.quick else (1.0, 1.5, 2.0, 3.0)
    parts.append(
        (
            "a map of a noisy log",
            lambda: audit_mapped_log(
                results, frames=frames, width=width, spheres=count, configurations=count, n_sigmas=sigmas
            ),
        )
    )
    if settings.run is not None:
        folder = settings.run
        parts.append(("a recorded log", lambda: audit_run(results, folder, settings.folder, points=100_000)))
    if settings.peers:
        parts.append(("peers", lambda: run_peers(settings, results, scene, arm, report_progress)))
    for name, part in parts:
        report_progress(name)
        with threads(1 if name == "peers" else max(settings.threads)):
            part()
        settings.save(results)
    return results


def run_speed(
    settings: CollisionSettings,
    results: Results,
    case: str,
    model: GaussianModel,
    arm: RobotSpheres,
    q: Array,
    *,
    packed: bool = False,
) -> None:
    """Build, update, memory, and questions a second."""
    rng = np.random.default_rng(1)
    results.add_time(case, "build", measure(lambda: GaussianCollisionField(model, packed=packed), runs=settings.runs))
    field = GaussianCollisionField(model, packed=packed)
    results.add(case, "memory", field.nbytes / 1e6, "MB")
    later, changed = _keyframe(model, rng)
    results.add_time(
        case,
        "update by a keyframe's 2,000 Gaussians",
        measure(lambda: field.updated(later, changed), runs=settings.runs),
    )
    near = np.c_[rng.uniform([0.2, -0.5, 0.0], [0.8, 0.7, 0.4], (20_000, 3)), np.full(20_000, 0.05)]
    rate = partial(_add_rate, results, case, settings.runs)
    rate("5 cm spheres in the clutter", len(near), lambda: field.in_collision(near))
    points = np.ascontiguousarray(near[:10_000, :3])
    rate("exact clearance in the clutter", len(points), lambda: field.clearance(points, cut=0.2))
    rate("Mahalanobis distance in the clutter", len(points), lambda: field.mahalanobis(points))
    rate("configurations", len(q), lambda: arm.check(field, q))
    some = q[: min(len(q), 5000)]
    rate("configurations with clearance", len(some), lambda: arm.clearance(field, some, cut=0.2))
    start, end = free_edges(arm, field, q[:20_000], rng, 50 if settings.quick else 2000)
    for metric, ask in (
        ("1 rad edge, certified", lambda a, b: arm.native.certify(field.native, a, b, EPS)),
        ("1 rad edge, 32 samples", lambda a, b: arm.native.sample(field.native, a, b, 32)),
    ):
        spent = np.array([_seconds(ask, start[i : i + 1], end[i : i + 1]) for i in range(len(start))])
        results.add(case, f"{metric}, median of single calls", 1e6 * float(np.median(spent)), "us")
        timing = measure(lambda ask=ask: ask(start, end), runs=settings.runs)  # type: ignore[misc]
        results.add(case, f"{metric}, mean in a batch", 1e3 * timing.least_ms / len(start), "us")


def _keyframe(model: GaussianModel, rng: np.random.Generator) -> tuple[GaussianModel, NDArray[np.bool_]]:
    """Add the Gaussians of one keyframe to a map: 2,000 within 0.3 m."""
    count = 2000
    part = model.select(torch.from_numpy(rng.integers(0, len(model), count)))
    part.means[:] = torch.from_numpy(rng.uniform([0.4, -0.2, 0.2], [0.7, 0.1, 0.3], (count, 3))).float()
    later = GaussianModel.concatenate([model, part])
    return later, np.arange(len(later)) >= len(model)


def free_edges(
    arm: RobotSpheres, field: GaussianCollisionField, q: Array, rng: np.random.Generator, count: int
) -> tuple[Array, Array]:
    """Sample up to ``count`` edges of 1 rad whose ends are free."""
    start = q[~arm.check(field, q).in_collision]
    step = rng.normal(size=start.shape)
    end = start + step / np.linalg.norm(step, axis=1, keepdims=True)
    chain = arm.robot.chain
    inside = ((end >= chain.lower) & (end <= chain.upper)).all(axis=1) & ~arm.check(field, end).in_collision
    return start[inside][:count], end[inside][:count]


def run_errors(settings: CollisionSettings, results: Results, scene: Tabletop, arm: RobotSpheres) -> None:
    """Measure errors of configurations over n_sigma and the number of Gaussians, and of edges over samples."""
    rng = np.random.default_rng(2)
    truth = Truth(scene, settings.truth_step)
    q = without_self_collision(arm, panda().random(int(1.6 * settings.audited), rng))[: settings.audited]
    clearances = truth.clearances(arm, q)
    few = slice(None, max(1, len(q) // 5))
    for count in settings.counts:
        model = scene.gaussians(count)
        for n_sigma in (0.5, 1.0, 1.5, 2.0, 3.0) if count == settings.reference else (2.0,):
            field = GaussianCollisionField(model, n_sigma)
            whole = count == settings.reference and n_sigma == 2.0
            part = slice(None) if whole else few
            case = f"{SWEEP} n_sigma on {count} Gaussians: {n_sigma:g}{' (default)' if n_sigma == 2.0 else ''}"
            spent = _seconds(arm.check, field, q[part])
            add_audit(results, case, audit(field, arm, q[part], clearances[part]))
            results.add(case, "a configuration", 1e6 * spent / len(q[part]), "us")
    model = scene.gaussians(settings.reference)
    for packed in (False, True):
        field = GaussianCollisionField(model, packed=packed)
        case = f"{SWEEP} storage of {settings.reference} Gaussians: {'packed' if packed else 'float32 (default)'}"
        spent = _seconds(arm.check, field, q[few])
        add_audit(results, case, audit(field, arm, q[few], clearances[few]))
        results.add(case, "a configuration", 1e6 * spent / len(q[few]), "us")
        results.add(case, "memory", field.nbytes / 1e6, "MB")
    field = GaussianCollisionField(model)
    run_edges(settings, results, truth, arm, field, q)


def run_edges(
    settings: CollisionSettings,
    results: Results,
    truth: Truth,
    arm: RobotSpheres,
    field: GaussianCollisionField,
    q: Array,
) -> None:
    """Measure the collisions that certified and sampled edges miss, with the truth every 1/128 rad."""
    rng = np.random.default_rng(3)
    wanted = int(1.1 * settings.audited_edges)
    start, end = free_edges(arm, field, q[: 6 * wanted], rng, wanted)
    least = np.full(len(start), np.inf)
    self_hit = np.zeros(len(start), bool)
    for t in np.linspace(0, 1, 9 if settings.quick else 129):
        at = start + t * (end - start)
        least = np.minimum(least, truth.clearances(arm, at))
        self_hit |= arm.check(None, at).in_collision
    methods: list[tuple[str, Any]] = [("certified, 1 mm", 1e-3), ("certified, 3 mm", 3e-3)]
    methods += [(f"{n} samples", n) for n in (4, 8, 16, 32, 64)]
    for label, knob in methods:
        case = f"{SWEEP} edges on {settings.reference} Gaussians: {label}{' (default)' if knob == 1e-3 else ''}"
        begin = time.perf_counter()
        answer = arm.certify(field, start, end, eps=knob) if knob < 1 else arm.sample(field, start, end, samples=knob)
        results.add(case, "an edge", 1e6 * (time.perf_counter() - begin) / len(start), "us")
        add_audit(results, case, score(answer.in_collision, least))
        missed = int((~answer.in_collision & self_hit).sum())
        results.add(case, "self-collisions missed", float(missed), "edges")
        results.add(case, "edges reported free", float((~answer.in_collision).sum()), "edges")


def run_floaters(settings: CollisionSettings, results: Results, scene: Tabletop, arm: RobotSpheres) -> None:
    """Measure the configurations that 1 % of floaters block, with and without the gates.

    Evidence is gathered from depth images of the true shapes. Floaters have random opacities and 0 to 2 observations.
    """
    rng = np.random.default_rng(4)
    model = scene.gaussians(settings.reference if settings.quick else 50_000)
    count = len(model) // 100
    air = rng.uniform([0.25, -0.7, 0.0], [0.9, 0.8, 0.9], (20 * count, 3))
    air = air[scene.distance(air) > 0.03][:count]
    floaters = GaussianModel.from_activated(
        means=air,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 5e-3),
        opacities=rng.uniform(0.05, 0.9, count),
        colors=np.full((count, 3), 0.5),
    )
    floaters.observations[:] = torch.from_numpy(rng.integers(0, 3, count)).to(torch.int32)
    dirty = GaussianModel.concatenate([model, floaters])
    evidence = gather_evidence(dirty, depth_views(scene, 4 if settings.quick else 24))
    q = without_self_collision(arm, panda().random(2000 if settings.quick else 100_000, rng))
    clearances = Truth(scene, settings.truth_step).clearances(arm, q)
    for label, found in (
        ("clean map", GaussianCollisionField(model)),
        ("1 % floaters, none", GaussianCollisionField(dirty, min_opacity=0.0, min_observations=0)),
        ("1 % floaters, 1 observation (default)", GaussianCollisionField(dirty)),
        ("1 % floaters, opacity 0.3", GaussianCollisionField(dirty, min_opacity=0.3, min_observations=0)),
        ("1 % floaters, seen through", GaussianCollisionField(dirty, min_observations=0, evidence=evidence)),
        ("1 % floaters, all three", GaussianCollisionField(dirty, min_opacity=0.3, evidence=evidence)),
    ):
        add_audit(results, f"gate: {label}", audit(found, arm, q, clearances))


def depth_views(scene: Tabletop, count: int) -> Iterator[tuple[NDArray[np.float32], Camera, Array]]:
    """Render depth images of the true shapes from a ring around them."""
    vertices, triangles = mesh_of(scene)
    ray = o3d.t.geometry.RaycastingScene()
    corners = o3d.core.Tensor.from_numpy(vertices.astype(np.float32))
    ray.add_triangles(corners, o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)))
    camera = Camera(280.0, 280.0, 159.5, 119.5, 320, 240)
    for turn in np.linspace(0, 2 * np.pi, count, endpoint=False):
        eye = np.array([0.5 + 1.1 * np.cos(turn), 1.1 * np.sin(turn), 0.4 + 0.5 * (np.cos(3 * turn) + 1)])
        T = look_at(eye, np.array([0.5, 0.0, 0.2]))
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        along = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float)], axis=-1)
        rays = np.concatenate([np.broadcast_to(eye, along.shape), along @ T[:3, :3].T], axis=-1).astype(np.float32)
        depth = ray.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()  # z: the rays have z = 1
        yield np.where(np.isfinite(depth), depth, 5.0).astype(np.float32), camera, T


def run_peers(
    settings: CollisionSettings,
    results: Results,
    scene: Tabletop,
    arm: RobotSpheres,
    report_progress: ReportProgress,
) -> None:
    """Measure brute force on the same points, and meshes of the same shapes on the same configurations."""
    rng = np.random.default_rng(5)
    model = scene.gaussians(settings.counts[0] if settings.quick else 100_000)
    points = rng.uniform([0.0, -0.8, -0.05], [1.0, 0.9, 0.7], (200 if settings.quick else 10_000, 3))
    run_brute_force(results, model, points, report_progress)
    q = without_self_collision(arm, panda().random(40 if settings.quick else 2000, rng))
    run_mesh_peers(results, scene, arm, q, report_progress)


def add_audit(results: Results, case: str, found: Audit) -> None:
    """Add the errors as rows."""
    results.add(case, "false free", 100.0 * found.false_free / max(1, found.configurations), "%")
    results.add(case, "false free, count", float(found.false_free), f"of {found.configurations}")
    results.add(case, "deepest false free", 1e3 * found.deepest_m, "mm")
    results.add(case, "false hit", found.false_hit_percent, "%")
    results.add(case, "largest false hit", 1e3 * found.largest_m, "mm")
    results.add(case, "reported free", found.free_percent, "%")


def _add_rate(results: Results, case: str, runs: int, metric: str, count: int, query: Callable[[], object]) -> None:
    """Add the rate [M/s] of a query of ``count`` elements."""
    timing: Timing = measure(query, runs=runs, budget_s=1.5)
    results.add(case, metric, 1e-6 * count / (1e-3 * timing.least_ms), "M/s")


def _seconds(ask: Callable[..., object], *arguments: object) -> float:
    start = time.perf_counter()
    ask(*arguments)
    return time.perf_counter() - start
