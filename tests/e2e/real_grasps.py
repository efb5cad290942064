"""Grasps on the maps of recordings, held to what does not come from the map: raw pictures and depth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.cli import main
from splatbot.logs import open_log

WIDTH = 0.008  # [m] that a width may be off
SHELF_BOX = (228, 333)  # [px] the edges of its front in frame 12
FRICTION = 0.5


def check_shelf_box(log: Path, run: Path) -> None:
    """The tissue box in the shelf, apart from the walls that it touches: as wide as in the picture."""
    grasps = _grasped(run, "--box", "350", "262", "445", "385", "--robot", "panda-2f140")
    frame = open_log(log)[12]  # which looks straight at it
    depth = frame.depth[190:265, 240:320]
    wide = (SHELF_BOX[1] - SHELF_BOX[0]) * float(np.median(depth[depth > 0])) / frame.camera.fx
    for grasp in grasps:
        _held_and_free(grasp)
    assert abs(grasps[0]["width_m"] - wide) < WIDTH


def _grasped(run: Path, *words: str) -> list[dict[str, Any]]:
    """The ranked grasps, as a user asks for them; the best is drawn."""
    assert (run / "scene.yaml").is_file() or main(["info", str(run), "--fit-plane"]) == 0
    out = run / "grasp"
    assert main(["grasp", "--map", str(run), "--min-observations", "3", "--out", str(out), *words]) == 0
    assert (out / "grasp.png").stat().st_size > 10_000
    grasps: list[dict[str, Any]] = json.loads((out / "grasp.json").read_text())["grasps"]
    assert grasps
    return grasps


def _held_and_free(grasp: dict[str, Any]) -> None:
    """Both normals are within the friction cone about the line between the contacts, and there is room on the way."""
    contacts, normals = np.array(grasp["contacts"]), np.array(grasp["normals"])
    line = (contacts[1] - contacts[0]) / np.linalg.norm(contacts[1] - contacts[0])
    cosines = np.array([-normals[0] @ line, normals[1] @ line])
    assert np.degrees(np.arccos(cosines)).max() < np.degrees(np.arctan(FRICTION))
    assert grasp["room_m"] > 0.0
    assert grasp["opening_m"] >= grasp["width_m"]
    assert grasp["approach_path"] is not None
