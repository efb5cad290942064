"""`splatbot bench collision`: the collision field's speed and memory, and how wrong it is, against exact truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray

from splatbot.bench.collision_mapped import audit_mapped_log
from splatbot.bench.collision_maps import audit_run
from splatbot.bench.collision_peers import mesh_of, run_brute_force, run_mesh_peers
from splatbot.bench.collision_plots import plot_accuracy
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.tabletop import Tabletop, tabletop
from splatbot.bench.timing import Timing, measure, threads
from splatbot.bench.truth import Audit, Truth, apart_from_itself, audit, score
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres, gather_evidence
from splatbot.collision.robot import EPS
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.protocols import Array
from splatbot.robots.panda import panda

Say = Callable[[str], None]
SWEEP = "sweep"


@dataclass(frozen=True)
class CollisionPlan:
    """What to run.

    Args:
        counts: of Gaussians.
        configurations: of the arm to time with.
        audited: configurations to compare with the truth.
        audited_edges: certified edges to look along.
        thread_counts: to measure with.
        peers: measure other implementations too.
        quick: tiny: whether it runs, not how fast.
        say: told what goes on.
        run: a run folder of `splatbot map`, to compare with its log's raw depth; None: none.
    """

    counts: tuple[int, ...] = (10_000, 50_000, 200_000, 500_000)
    configurations: int = 200_000
    audited: int = 1_000_000
    audited_edges: int = 100_000
    thread_counts: tuple[int, ...] = (1, 2)
    peers: bool = False
    quick: bool = False
    say: Say = field(default=lambda text: None)
    run: Path | None = None

    @classmethod
    def quick_plan(cls, *, peers: bool = False, say: Say = lambda text: None) -> CollisionPlan:
        """A run of seconds."""
        return cls((2000, 4000), 2000, 2000, 100, (1, 2), peers, True, say)

    @property
    def truth_step(self) -> float:
        """Of the truth's grid [m]."""
        return 0.1 if self.quick else 0.02

    @property
    def runs(self) -> int:
        """Of each measurement."""
        return 1 if self.quick else 9

    @property
    def reference(self) -> int:
        """The number of Gaussians that errors are told for."""
        return 4000 if self.quick else 200_000


def run_collision(plan: CollisionPlan, out: Path) -> Results:
    """Run the plan; write collision.json (after each part), collision.csv and the plots into ``out``."""
    plan.say("measuring the machine")
    results = Results(describe_machine(plan.thread_counts, peak_ms=20.0 if plan.quick else 200.0))
    out.mkdir(parents=True, exist_ok=True)
    scene, arm = tabletop(), RobotSpheres(panda())
    rng = np.random.default_rng(0)
    q = panda().random(plan.configurations, rng)
    for count in plan.counts:
        model = scene.gaussians(count)
        for n in plan.thread_counts:
            case = f"{count} Gaussians, {n} thread{'s' if n > 1 else ''}"
            plan.say(case)
            with threads(n):
                run_speed(plan, results, case, model, arm, q)
                if count == plan.reference:
                    run_speed(plan, results, f"{case}, packed", model, arm, q, packed=True)
        results.write_json(out / "collision.json")
    parts: list[tuple[str, Callable[[], None]]] = [
        ("errors against exact truth", lambda: run_errors(plan, results, scene, arm)),
        ("floaters", lambda: run_floaters(plan, results, scene, arm)),
    ]
    frames, width, count = (3, 80, 200) if plan.quick else (30, 320, 50_000)
    sigmas = (2.0,) if plan.quick else (1.0, 1.5, 2.0, 3.0)
    parts.append(
        (
            "a map of a noisy log",
            lambda: audit_mapped_log(
                results, frames=frames, width=width, spheres=count, configurations=count, n_sigmas=sigmas
            ),
        )
    )
    if plan.run is not None:
        folder = plan.run
        parts.append(("a recorded log", lambda: audit_run(results, folder, out, points=100_000)))
    if plan.peers:
        parts.append(("peers", lambda: run_peers(plan, results, scene, arm)))
    for name, part in parts:
        plan.say(name)
        with threads(1 if name == "peers" else max(plan.thread_counts)):
            part()
        results.write_json(out / "collision.json")
    results.write_csv(out / "collision.csv")
    plot_accuracy(results, out)
    return results


def run_speed(
    plan: CollisionPlan,
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
    results.add_time(case, "build", measure(lambda: GaussianCollisionField(model, packed=packed), runs=plan.runs))
    field = GaussianCollisionField(model, packed=packed)
    results.add(case, "memory", field.nbytes / 1e6, "MB")
    later, changed = _keyframe(model, rng)
    results.add_time(
        case, "update by a keyframe's 2,000 Gaussians", measure(lambda: field.updated(later, changed), runs=plan.runs)
    )
    near = np.c_[rng.uniform([0.2, -0.5, 0.0], [0.8, 0.7, 0.4], (20_000, 3)), np.full(20_000, 0.05)]
    _rate(plan, results, case, "5 cm spheres in the clutter", len(near), lambda: field.in_collision(near))
    points = np.ascontiguousarray(near[:10_000, :3])
    _rate(plan, results, case, "exact clearance in the clutter", len(points), lambda: field.clearance(points, cut=0.2))
    _rate(plan, results, case, "Mahalanobis distance in the clutter", len(points), lambda: field.mahalanobis(points))
    _rate(plan, results, case, "configurations", len(q), lambda: arm.check(field, q))
    some = q[: min(len(q), 5000)]
    _rate(plan, results, case, "configurations with clearance", len(some), lambda: arm.clearance(field, some, cut=0.2))
    start, end = free_edges(arm, field, q[:20_000], rng, 50 if plan.quick else 2000)
    for metric, ask in (
        ("1 rad edge, certified", lambda a, b: arm.native.certify(field.native, a, b, EPS)),
        ("1 rad edge, 32 samples", lambda a, b: arm.native.sample(field.native, a, b, 32)),
    ):
        spent = np.array([_seconds(ask, start[i : i + 1], end[i : i + 1]) for i in range(len(start))])
        results.add(case, f"{metric}, median of single calls", 1e6 * float(np.median(spent)), "us")
        timing = measure(lambda ask=ask: ask(start, end), runs=plan.runs)  # type: ignore[misc]
        results.add(case, f"{metric}, mean in a batch", 1e3 * timing.least_ms / len(start), "us")


def _keyframe(model: GaussianModel, rng: np.random.Generator) -> tuple[GaussianModel, NDArray[np.bool_]]:
    """The map with what one keyframe adds: 2,000 Gaussians in 0.3 m of space."""
    count = 2000
    part = model.select(torch.from_numpy(rng.integers(0, len(model), count)))
    part.means[:] = torch.from_numpy(rng.uniform([0.4, -0.2, 0.2], [0.7, 0.1, 0.3], (count, 3))).float()
    later = GaussianModel.concatenate([model, part])
    return later, np.arange(len(later)) >= len(model)


def free_edges(
    arm: RobotSpheres, field: GaussianCollisionField, q: Array, rng: np.random.Generator, count: int
) -> tuple[Array, Array]:
    """Up to ``count`` edges of 1 rad whose ends are free."""
    start = q[~arm.check(field, q).in_collision]
    step = rng.normal(size=start.shape)
    end = start + step / np.linalg.norm(step, axis=1, keepdims=True)
    chain = arm.robot.chain
    inside = ((end >= chain.lower) & (end <= chain.upper)).all(axis=1) & ~arm.check(field, end).in_collision
    return start[inside][:count], end[inside][:count]


def run_errors(plan: CollisionPlan, results: Results, scene: Tabletop, arm: RobotSpheres) -> None:
    """The two errors: of configurations over n_sigma and the number of Gaussians, and of edges over samples."""
    rng = np.random.default_rng(2)
    truth = Truth(scene, plan.truth_step)
    q = apart_from_itself(arm, panda().random(int(1.6 * plan.audited), rng))[: plan.audited]
    rooms = truth.rooms(arm, q)
    few = slice(None, max(1, len(q) // 5))
    for count in plan.counts:
        model = scene.gaussians(count)
        for n_sigma in (0.5, 1.0, 1.5, 2.0, 3.0) if count == plan.reference else (2.0,):
            field = GaussianCollisionField(model, n_sigma)
            whole = count == plan.reference and n_sigma == 2.0
            part = slice(None) if whole else few
            case = f"{SWEEP} n_sigma on {count} Gaussians: {n_sigma:g}{' (default)' if n_sigma == 2.0 else ''}"
            spent = _seconds(arm.check, field, q[part])
            add_audit(results, case, audit(field, arm, q[part], rooms[part]))
            results.add(case, "a configuration", 1e6 * spent / len(q[part]), "us")
    model = scene.gaussians(plan.reference)
    for packed in (False, True):
        field = GaussianCollisionField(model, packed=packed)
        case = f"{SWEEP} storage of {plan.reference} Gaussians: {'packed' if packed else 'float32 (default)'}"
        spent = _seconds(arm.check, field, q[few])
        add_audit(results, case, audit(field, arm, q[few], rooms[few]))
        results.add(case, "a configuration", 1e6 * spent / len(q[few]), "us")
        results.add(case, "memory", field.nbytes / 1e6, "MB")
    field = GaussianCollisionField(model)
    run_edges(plan, results, truth, arm, field, q)


def run_edges(
    plan: CollisionPlan, results: Results, truth: Truth, arm: RobotSpheres, field: GaussianCollisionField, q: Array
) -> None:
    """What certified and sampled edges miss, looked at every 1/128 rad."""
    rng = np.random.default_rng(3)
    wanted = int(1.1 * plan.audited_edges)
    start, end = free_edges(arm, field, q[: 6 * wanted], rng, wanted)
    least = np.full(len(start), np.inf)
    self_hit = np.zeros(len(start), bool)
    for t in np.linspace(0, 1, 9 if plan.quick else 129):
        at = start + t * (end - start)
        least = np.minimum(least, truth.rooms(arm, at))
        self_hit |= arm.check(None, at).in_collision
    settings: list[tuple[str, Any]] = [("certified, 1 mm", 1e-3), ("certified, 3 mm", 3e-3)]
    settings += [(f"{n} samples", n) for n in (4, 8, 16, 32, 64)]
    for label, knob in settings:
        case = f"{SWEEP} edges on {plan.reference} Gaussians: {label}{' (default)' if knob == 1e-3 else ''}"
        begin = time.perf_counter()
        answer = arm.certify(field, start, end, eps=knob) if knob < 1 else arm.sample(field, start, end, samples=knob)
        results.add(case, "an edge", 1e6 * (time.perf_counter() - begin) / len(start), "us")
        add_audit(results, case, score(answer.in_collision, least))
        missed = int((~answer.in_collision & self_hit).sum())
        results.add(case, "self-collisions missed", float(missed), "edges")
        results.add(case, "edges called free", float((~answer.in_collision).sum()), "edges")


def run_floaters(plan: CollisionPlan, results: Results, scene: Tabletop, arm: RobotSpheres) -> None:
    """1 % of floaters in the air: what they block, and what the gates give back.

    Evidence is gathered from depth images of the true shapes. Floaters have random opacities and 0 to 2 observations.
    """
    rng = np.random.default_rng(4)
    model = scene.gaussians(plan.reference if plan.quick else 50_000)
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
    evidence = gather_evidence(dirty, depth_views(scene, 4 if plan.quick else 24))
    q = apart_from_itself(arm, panda().random(2000 if plan.quick else 100_000, rng))
    rooms = Truth(scene, plan.truth_step).rooms(arm, q)
    for label, found in (
        ("clean map", GaussianCollisionField(model)),
        ("1 % floaters, none", GaussianCollisionField(dirty, min_opacity=0.0, min_observations=0)),
        ("1 % floaters, 1 observation (default)", GaussianCollisionField(dirty)),
        ("1 % floaters, opacity 0.3", GaussianCollisionField(dirty, min_opacity=0.3, min_observations=0)),
        ("1 % floaters, seen through", GaussianCollisionField(dirty, min_observations=0, evidence=evidence)),
        ("1 % floaters, all three", GaussianCollisionField(dirty, min_opacity=0.3, evidence=evidence)),
    ):
        add_audit(results, f"gate: {label}", audit(found, arm, q, rooms))


def depth_views(scene: Tabletop, count: int) -> Iterator[tuple[NDArray[np.float32], Camera, Array]]:
    """Depth images of the true shapes from a ring around them."""
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


def run_peers(plan: CollisionPlan, results: Results, scene: Tabletop, arm: RobotSpheres) -> None:
    """Brute force on the same points; meshes of the same shapes on the same configurations."""
    rng = np.random.default_rng(5)
    model = scene.gaussians(plan.counts[0] if plan.quick else 100_000)
    points = rng.uniform([0.0, -0.8, -0.05], [1.0, 0.9, 0.7], (200 if plan.quick else 10_000, 3))
    run_brute_force(results, model, points, plan.say)
    q = apart_from_itself(arm, panda().random(40 if plan.quick else 2000, rng))
    run_mesh_peers(results, scene, arm, q, plan.say)


def add_audit(results: Results, case: str, found: Audit) -> None:
    """Its figures as rows."""
    results.add(case, "false free", 100.0 * found.false_free / max(1, found.configurations), "%")
    results.add(case, "false free, count", float(found.false_free), f"of {found.configurations}")
    results.add(case, "deepest false free", 1e3 * found.deepest_m, "mm")
    results.add(case, "false hit", found.false_hit_percent, "%")
    results.add(case, "largest false hit", 1e3 * found.largest_m, "mm")
    results.add(case, "called free", found.free_percent, "%")


def _rate(plan: CollisionPlan, results: Results, case: str, metric: str, count: int, ask: Callable[[], object]) -> None:
    timing: Timing = measure(ask, runs=plan.runs, budget_s=1.5)
    results.add(case, metric, 1e-6 * count / (1e-3 * timing.least_ms), "M/s")


def _seconds(ask: Callable[..., object], *arguments: object) -> float:
    start = time.perf_counter()
    ask(*arguments)
    return time.perf_counter() - start
