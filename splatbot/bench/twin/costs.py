"""Measurements of `splatbot bench twin`: cost of a step and of each effect, time steps, paths, pictures."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.tabletop import tabletop
from splatbot.bench.twin import TwinSettings
from splatbot.bench.twin.bounds import EXACT, FILMED, FORCED
from splatbot.bench.twin.composite import exact_map, filmed_map
from splatbot.bench.twin.paths import CONSTANTS as PATHS
from splatbot.bench.twin.paths import try_paths
from splatbot.errors import NativeError
from splatbot.protocols import Array
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.panda import panda
from splatbot.sim.ledger import ledger
from splatbot.sim.scene import Scene, load_scene, make_scene, scene_names
from splatbot.sim.twin import Twin

_STEP = 0.002  # [s] of the step costs


def run_twin(settings: TwinSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure costs of steps and effects, errors of time steps, paths, and composite pictures."""
    results = Results(describe_machine((1,), peak_ms=10.0))
    _step_costs(results, settings, report_progress)
    _effects(results, settings, report_progress)
    _time_steps(results, settings, report_progress)
    _paths(results, settings, report_progress)
    _composites(results, settings, report_progress)
    return results


def _step_costs(results: Results, settings: TwinSettings, report_progress: ReportProgress) -> None:
    report_progress("cost of a step")
    model = mujoco.MjModel.from_xml_string(to_mjcf(panda()))
    model.opt.timestep = _STEP
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    empty = Twin(load_scene("empty"))
    empty.world.model.opt.timestep = _STEP
    forced = Twin(load_scene("empty").with_effects(force=("contact", "fluid_drag")))
    forced.world.model.opt.timestep = _STEP
    bare, ours, more = (float("inf"),) * 3
    for _ in range(3):  # in turns: a busy moment must not hit one alone
        bare = min(bare, step_us(model, data, settings.steps))
        ours = min(ours, step_us(empty.world.model, empty.data, settings.steps))
        more = min(more, step_us(forced.world.model, forced.data, settings.steps))
    results.add("robot alone", "step", bare, "us", note="mj_step of its MJCF")
    results.add("empty scene", "step", ours, "us")
    results.add("empty scene", "over the robot alone", ours / bare, "x")
    results.add(FORCED, "step", more, "us")
    results.add(FORCED, "over none forced", more / ours, "x")
    for name, ellipsoids in (("2,000 map geoms, robot, 4 objects", 2000), ("500 map geoms, robot, 4 objects", 500)):
        with TemporaryDirectory() as temporary:
            scene = cluttered(ellipsoids, 2000 if settings.quick else settings.gaussians, Path(temporary))
            _cluttered_steps(results, settings, name, scene)


def _cluttered_steps(results: Results, settings: TwinSettings, name: str, scene: Scene) -> None:
    for state, forbid in (("awake", ("sleep",)), ("asleep", ())):
        twin = Twin(scene.with_effects(forbid=forbid), timestep=_STEP)
        twin.world.model.opt.timestep = _STEP
        mujoco.mj_step(twin.world.model, twin.data, 1500)
        cost = step_us(twin.world.model, twin.data, settings.steps)
        note = f"{twin.world.model.ngeom} geoms, {int(twin.data.ncon)} contacts"
        results.add(f"{name}, {state}", "step", cost, "us", note=note)


def cluttered(ellipsoids: int, gaussians: int, folder: Path) -> Scene:
    """Build the table top's map as a plane and at most ``ellipsoids``, with a robot and four free boxes."""
    file = folder / "map.ply"
    tabletop().gaussians(gaussians).save(file)
    boxes = [
        {"name": f"box{i}", "shapes": [{"kind": "box", "size": [0.05] * 3}], "at": at, "movable": True}
        for i, at in enumerate(([0.25, 0.0, 0.027], [0.3, 0.45, 0.027], [0.3, -0.5, 0.027], [0.8, -0.4, 0.027]))
    ]
    clutter = {"file": str(file), "objects": False, "ellipsoids": ellipsoids}
    return make_scene({"name": "cluttered", "map": clutter, "objects": boxes})


def step_us(model: Any, data: Any, steps: int) -> float:
    """Measure the least time of a step over nine parts of ``steps`` [us]."""
    share, best = max(1, steps // 9), float("inf")
    for _ in range(9):
        start = time.perf_counter()
        mujoco.mj_step(model, data, share)
        best = min(best, (time.perf_counter() - start) / share)
    return 1e6 * best


def _effects(results: Results, settings: TwinSettings, report_progress: ReportProgress) -> None:
    for name in settings.scene or (("wiping",) if settings.quick else scene_names()):
        report_progress(f"effects of {name}")
        twin = Twin(load_scene(name))
        result = twin.follow()
        results.add(f"scene {name}", "step, all effects", 1e6 * result.physics_seconds / result.steps, "us")
        results.add(f"scene {name}", "faster than real time", result.real_time, "x")
        on = [entry for entry in ledger(twin, result) if entry.on]
        for entry in on:
            results.add(f"scene {name}", f"cost of {entry.name}", entry.us_per_step, "us", note=entry.why)
        if on:
            bare = Twin(twin.scene.with_effects(forbid=tuple(entry.name for entry in on))).follow()
            results.add(f"scene {name}", "step, no effects", 1e6 * bare.physics_seconds / bare.steps, "us")


def _time_steps(results: Results, settings: TwinSettings, report_progress: ReportProgress) -> None:
    """Compare time steps with one ten times finer than the finest, at the same rate of the controller."""
    for name in ("empty", "tabletop_clutter"):
        report_progress(f"time steps in {name}")
        values = load_scene(name).model_dump()
        values["robot"]["motors"]["rate"] = 1.0 / max(settings.timesteps) if settings.quick else 125.0
        scene = make_scene(values)
        reference, _ = _track(scene, min(settings.timesteps) / 10)
        for step in settings.timesteps:
            track, cost = _track(scene, step)
            error = float(np.linalg.norm(track - reference, axis=1).max())
            case = f"time step {1e3 * step:g} ms, {name}"
            results.add(case, "error of bodies", 1e3 * error, "mm", note="of any body, at any time")
            results.add(case, "cost", cost, "ms/s")


def _track(scene: Scene, step: float) -> tuple[Array, float]:
    """Return positions (K, 3) of all bodies at 12.5 Hz, and the time of physics per simulated second [ms/s]."""
    twin = Twin(scene, timestep=step)
    found: list[Array] = []
    every = max(1, round(twin.rate * 0.08))

    def look(data: Any, now: float) -> None:
        if round(now * twin.rate) % every == 0:
            found.append(data.xpos.copy())

    result = twin.follow(watch=look)
    return np.concatenate(found), 1e3 * result.physics_seconds / result.duration


def _paths(results: Results, settings: TwinSettings, report_progress: ReportProgress) -> None:
    trials = try_paths(
        settings.paths, gaussians=settings.gaussians, budget_ms=settings.budget_ms, report_progress=report_progress
    )
    case = "planned paths among the true shapes"
    results.add(case, "planned", trials.planned, "", note=f"of {trials.problems}")
    results.add(case, "certified", trials.certified, "")
    results.add(case, "in contact", trials.in_contact, "", note="of those planned")
    results.add(case, "least clearance", 1e3 * trials.least_clearance, "mm")
    results.add(case, f"pushed {1e3 * PATHS.push_depth:g} mm in", trials.pushed, "")
    results.add(case, "detected as contact", trials.detected, "", note="of those pushed")
    results.add(case, "faster than real time", trials.real_time, "x")


def _composites(results: Results, settings: TwinSettings, report_progress: ReportProgress) -> None:
    report_progress("composite pictures")
    try:
        exact = exact_map(
            settings.poses,
            settings.gaussians if settings.quick else 4 * settings.gaussians,
            width=160 if settings.quick else 640,
        )
        filmed = filmed_map(settings.poses, 10 if settings.quick else 120, width=160 if settings.quick else 320)
    except NativeError as error:
        results.add("composite picture", "overlap", None, "", note=str(error))
        return
    for case, found in ((EXACT, exact), (FILMED, filmed)):
        results.add(case, "least overlap", float(found.overlap.min()), "", note="IoU of the robot's pixels")
        results.add(case, "median overlap", float(np.median(found.overlap)), "", note=f"{len(found.overlap)} poses")
        results.add(case, "farthest wrong pixel", float(found.astray.max()), "px", note="from the robot's outline")
    lost = float((filmed.plain_db - filmed.composite_db).max())
    results.add(FILMED, "PSNR", float(filmed.plain_db.mean()), "dB", note="the map alone")
    results.add(FILMED, "PSNR lost, most", lost, "dB", note="where the robot is not")
