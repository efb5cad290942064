"""Grasps on the maps of recordings against raw depth: hands in measured surfaces, and contacts without any."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.grasping import GraspingSettings
from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import Hands
from splatbot.grasping.measured import CONSTANTS, RawDepth, contact_distances, hand_penetration
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array, HandShape
from splatbot.results.folder import RunFolder
from splatbot.results.views import raw_views
from splatbot.robots.graspable_objects import measured_map, segment_objects
from splatbot.robots.hands import panda_2f85, panda_2f140
from splatbot.robots.in_view import reopen_log
from splatbot.robots.panda import panda
from splatbot.workspace import find_workspace

HANDS = {"panda": panda, "panda-2f85": panda_2f85, "panda-2f140": panda_2f140}
_FRAMES = 240  # whose depth checks the grasps; the search reads at most 120
_MIN_OBSERVATIONS = 3
_DEEP_M = 0.003  # of a confirmed point in a hand


def run_recorded(settings: GraspingSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Sample grasps of every object of each run with each hand, and compare them with raw depth."""
    results = Results(describe_machine((2,), peak_ms=settings.peak_ms))
    for path in settings.run:
        run = RunFolder(path)
        sensor, log = run.load_config().sensor, reopen_log(run)
        raw = RawDepth(raw_views(run, log, _FRAMES)[1], sensor.sigma_depth_floor, sensor.sigma_depth_quad)
        for name in HANDS:
            report_progress(f"{path.name}, {name}")
            _measure(results, f"{path.name} / {name}", path, name, raw, settings)
            settings.save(results)
    return results


def _measure(results: Results, case: str, path: Path, name: str, raw: RawDepth, settings: GraspingSettings) -> None:
    place = find_workspace(path)
    if place is None or place.T_world_base is None:
        hint = f"write a scene.yaml: splatbot info {path} --fit-plane"
        raise InputError("is not known.", file=path, field="T_world_base", hint=hint)
    state = measured_map(Snapshot(GaussianModel.load(path / "map.ply"), map_version=0), RunFolder(path))
    objects = segment_objects(state, place.T_world_base, place, as_known=True)
    robot = HANDS[name]()
    sampler = objects.sampler(robot, min_observations=_MIN_OBSERVATIONS)
    hand = sampler.hand
    points = objects.scene.model.means.detach().double().numpy()
    counts: Counter[str] = Counter()
    deepest, seconds = [0.0], []
    for one in objects.scene.objects[: 3 if settings.quick else None]:
        target = Target(one.rows, None, f"object {one.number}", "bench", 1.0, (), one.number)
        result = sampler.sample(target, GraspOptions(samples=100 if settings.quick else GraspOptions().samples))
        around = raw.around(points[one.rows], hand)
        seconds.append(sum(result.seconds.values()))
        counts["objects with a grasp"] += bool(result.grasps)
        counts["objects with grasps on implied sides alone"] += bool(result.doubtful) and not result.grasps
        counts["grasps"] += len(result.grasps)
        for grasp in result.grasps:
            on_way = raw.along_approach(Hands.one(grasp.T_world_tcp, grasp.opening), hand, grasp.approach_length)
            measured = np.concatenate([around, on_way])
            deep = _deepest(grasp, measured, hand)
            deepest.append(deep)
            counts["hands deeper than 3 mm in confirmed depth"] += deep > _DEEP_M
            away = contact_distances(grasp.contacts, measured)
            said = ~np.array(grasp.implied)
            counts["contacts"] += 2
            counts["contacts that are marked as implied"] += int((~said).sum())
            counts["other contacts farther than 3 mm from measured depth"] += int(
                (said & (away > CONSTANTS.contact_distance)).sum()
            )
    results.add(case, "objects", len(seconds), "")
    for metric in (
        "objects with a grasp",
        "objects with grasps on implied sides alone",
        "grasps",
        "hands deeper than 3 mm in confirmed depth",
        "contacts",
        "contacts that are marked as implied",
        "other contacts farther than 3 mm from measured depth",
    ):
        results.add(case, metric, counts[metric], "")
    results.add(case, "deepest confirmed point in a hand", 1e3 * max(deepest), "mm")
    results.add(case, "to a ranked list, median", 1e3 * float(np.median(seconds)) if seconds else None, "ms")


def _deepest(grasp: Grasp, measured: Array, hand: HandShape) -> float:
    """Return the depth of the deepest confirmed point in the hand, on its approach and closed [m]."""
    approaching = Hands.one(grasp.T_world_tcp, grasp.opening)
    return max(
        float(hand_penetration(approaching, measured, hand, retreat=grasp.approach_length)[0]),
        float(hand_penetration(Hands.one(grasp.T_world_tcp, grasp.width), measured, hand, retreat=0.0)[0]),
    )
