"""`splatbot demo`: a synthetic table top from the camera to a query, checked against the ground truth."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.cli.map_page import page_of_map
from splatbot.client import Client, Distances
from splatbot.errors import SplatbotError
from splatbot.geometry import transform_points
from splatbot.logs import Log, open_log
from splatbot.logs.record import record
from splatbot.run import Progress, map_log
from splatbot.serving import serving
from splatbot.sim.effects.base import Effects
from splatbot.sim.effects.depth_noise import DepthNoise


@dataclass(frozen=True)
class DemoConstants:
    """Constants of the demo.

    Args:
        table_height: [m] largest height of a ray-cast point on the table.
        tip_radius: [m] radius of the queried fingertip; a camera with 2 mm of noise cannot locate a single point.
    """

    table_height: float = 1e-3
    tip_radius: float = 0.005


CONSTANTS = DemoConstants()


def demo(*, out: Path = Path("runs/demo"), frames: int = 40) -> int:
    """Record a synthetic table top, map it, serve the map, and query free space.

    The queries ask whether a fingertip of 1 cm is free at a position on the table and at one in the air. Both are known
    exactly. The exit code is 1 if the map reports the table as free, or the air as occupied.

    Examples:
        splatbot demo
        splatbot demo --out runs/demo --frames 80

    Args:
        out: folder for the recording (log/), the map, metrics and the report; an earlier demo there is replaced.
        frames: length of the recording.
    """
    scene = open_log(f"synthetic:tabletop?frames={frames}")
    shutil.rmtree(out / "log", ignore_errors=True)
    _say(f"1/4 recording {frames} frames of a synthetic table top, with a depth camera's noise → {out / 'log'}")
    effects = Effects([DepthNoise(why="a depth camera measures no table top exactly")])
    record(effects.over(scene), out / "log", ground_truth=scene.ground_truth)
    _say("2/4 mapping the recording")
    run = map_log(open_log(out / "log"), out=out, on_progress=_tell, effects=effects.report(), map_page=page_of_map)
    if run.exit_code:
        _say(f"mapping ended early: {run.error or 'interrupted'}")
        return run.exit_code
    metrics = run.metrics
    _say(
        f"    {metrics['tracked']} of {metrics['frames']} frames tracked, {metrics['ms_per_frame']['p50']:.0f} ms each"
    )
    _say(f"    trajectory error {_mm(metrics['ate_rmse_m'])}, {metrics['gaussians']} Gaussians")
    question = _question(scene)
    with serving("--map", str(out / "map.ply"), log=out / "service.log") as service, Client(service.url) as client:
        _say(f"3/4 serving the map on {service.url}")
        _say("4/4 querying it over HTTP: POST /v1/maps/default/distance")
        answer = client.distance("default", _tips(question.places))
    wrong = _judge(question, answer)
    _say(f"report: {out / 'report.html'}      serve it again: splatbot serve --map {out / 'map.ply'}")
    return 1 if wrong else 0


@dataclass(frozen=True)
class _Question:
    """Positions (P, 3) [m, world frame of the map: the first camera], their names, and whether they are occupied."""

    places: NDArray[np.float64]
    names: tuple[str, ...]
    occupied: tuple[bool, ...]


def _question(scene: Log) -> _Question:
    """Choose a position on the table top, and one half-way from the camera to it, which is free space."""
    first = scene.read(0)
    truth = scene.ground_truth
    if truth is None:
        raise SplatbotError("has no ground truth.", field=scene.name)
    points = first.camera.backproject(first.depth).astype(np.float64)
    height = transform_points(truth.T_world_camera[0], points)[..., 2]
    table = (np.abs(height) < CONSTANTS.table_height).astype(np.uint8)
    inner = cv2.distanceTransform(cv2.copyMakeBorder(table, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), cv2.DIST_L2, 5)
    row, column = np.unravel_index(np.argmax(inner[1:-1, 1:-1]), table.shape)  # the farthest from any edge
    on_table = points[row, column]
    return _Question(
        places=np.stack([on_table, 0.5 * on_table]),
        names=("on the table top", "in the air, half-way to there from the camera"),
        occupied=(True, False),
    )


def _tips(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample points (P·T, 3) in a fingertip at each of the positions (P, 3)."""
    steps = np.linspace(-CONSTANTS.tip_radius, CONSTANTS.tip_radius, 5)
    cube = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    ball = cube[np.linalg.norm(cube, axis=1) <= CONSTANTS.tip_radius * (1 + 1e-9)]
    return (places[:, None] + ball).reshape(-1, 3)


def _judge(question: _Question, answer: Distances) -> int:
    """Print each answer next to the truth; return the number of contradictions."""
    wrong = 0
    touched = answer.inside.reshape(len(question.places), -1)
    nearest = answer.distance_sigma.reshape(touched.shape).min(axis=1)
    rows = zip(question.names, question.places, question.occupied, touched.sum(axis=1), nearest, strict=True)
    for name, place, occupied, inside, distance in rows:
        at = ", ".join(f"{x:+.3f}" for x in place)
        reported = "occupied" if inside else "free"
        verdict = "right" if bool(inside) == occupied else f"WRONG: it is {'occupied' if occupied else 'free'}"
        _say(f"    a fingertip {name} ({at}) m: {reported}  [{verdict}]")
        _say(f"        {inside} of its {touched.shape[1]} points are inside, the nearest at {distance:.1f} sigma")
        wrong += bool(inside) != occupied
    _say(f"    answered on map_version {answer.map_version}")
    return wrong


def _tell(progress: Progress) -> None:
    if progress.phase == "mapping" and progress.done % 10 == 0:
        _say(f"    frame {progress.done}/{progress.total}, {progress.gaussians} Gaussians")


def _mm(metres: float | None) -> str:
    return "unknown" if metres is None else f"{1000 * metres:.1f} mm"


def _say(text: str) -> None:
    print(text, flush=True)
