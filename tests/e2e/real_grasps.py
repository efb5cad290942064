"""Grasps on the maps of recordings, held to what does not come from the map: CAD, and depth as it was measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from splatbot.cli import main
from splatbot.geometry import transform_points
from splatbot.logs import open_log

CUBE = 0.085  # [m] of its CAD
NEAR, WIDTH = 0.003, 0.008  # [m] that a contact may be off the surface; that a width may be off
SHELF_BOX = (228, 333)  # [px] the edges of its front in frame 12
FRICTION = 0.5


def check_cube(log: Path, run: Path) -> None:
    """The picture cube, of which two sides and hardly the top were seen, in the hand that is wide enough for it."""
    best = _grasped(run, "--pixel", "270", "305", "--robot", "panda-2f140")
    contacts = np.array(best["contacts"])
    T = _cube_pose(log)
    local = (contacts - T[:3, 3]) @ T[:3, :3]
    away = np.abs(local) - CUBE / 2
    distance = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
    assert np.abs(distance).min() < NEAR  # of the side that was seen
    assert np.abs(distance).max() < WIDTH  # of that behind
    assert abs(best["width_m"] - CUBE) < WIDTH
    _held_and_free(best)


def check_shelf_box(log: Path, run: Path) -> None:
    """The tissue box in the shelf, apart from the walls that it touches."""
    best = _grasped(run, "--box", "350", "262", "445", "385", "--robot", "panda-2f140")
    _held_and_free(best)
    frame = open_log(log)[12]  # which looks straight at it
    depth = frame.depth[190:265, 240:320]
    wide = (SHELF_BOX[1] - SHELF_BOX[0]) * float(np.median(depth[depth > 0])) / frame.camera.fx
    assert abs(best["width_m"] - wide) < WIDTH


def _grasped(run: Path, *words: str) -> dict[str, Any]:
    """The best grasp, as a user asks for it; drawn too."""
    assert (run / "scene.yaml").is_file() or main(["info", str(run), "--fit-plane"]) == 0
    out = run / "grasp"
    assert main(["grasp", "--map", str(run), "--min-observations", "3", "--out", str(out), *words]) == 0
    assert (out / "grasp.png").stat().st_size > 10_000
    best: dict[str, Any] = json.loads((out / "grasp.json").read_text())["grasps"][0]
    return best


def _held_and_free(best: dict[str, Any]) -> None:
    """Both normals are within the friction cone about the line between the contacts, and there is room on the way."""
    contacts, normals = np.array(best["contacts"]), np.array(best["normals"])
    line = (contacts[1] - contacts[0]) / np.linalg.norm(contacts[1] - contacts[0])
    cosines = np.array([-normals[0] @ line, normals[1] @ line])
    assert np.degrees(np.arccos(cosines)).max() < np.degrees(np.arctan(FRICTION))
    assert best["room_m"] > 0.0
    assert best["opening_m"] >= best["width_m"]
    assert best["approach_path"] is not None


def _cube_pose(log: Path) -> np.ndarray:
    """T_world_cube (4, 4): as the recording gives it for its first frame, fitted to the depth of that frame (ICP)."""
    frame = open_log(log)[0]
    c, (v, u) = frame.camera, np.nonzero(frame.depth > 0)
    z = frame.depth[v, u].astype(np.float64)
    points = np.c_[(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z]
    T = np.array(json.loads((log / "object_init" / "cube.json").read_text()))
    local = transform_points(np.linalg.inv(T), points)
    points = points[(np.abs(local) < CUBE / 2 + 0.015).all(axis=1)]
    box = o3d.geometry.TriangleMesh.create_box(CUBE, CUBE, CUBE)
    box.translate([-CUBE / 2] * 3)
    box.compute_triangle_normals()
    surface = box.sample_points_uniformly(40_000, use_triangle_normal=True).transform(T)
    fit = o3d.pipelines.registration.registration_icp(
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)),
        surface,
        0.01,
        np.eye(4),
        o3d.pipelines.registration.TransformationEstimationPointToPlane(),
    )
    assert fit.fitness > 0.6
    assert fit.inlier_rmse < 0.004
    return np.asarray(np.linalg.inv(fit.transformation) @ T)
