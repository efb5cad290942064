"""Further cameras of a run, under the stable keys of ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from splatbot.geometry import rotation_to_quat
from splatbot.mapping.further_camera import FurtherCamera, MountedCamera
from splatbot.results.folder import FrameRow
from splatbot.results.units import degrees, metres


def camera_metrics(rows: Sequence[FrameRow], cameras: Mapping[str, FurtherCamera]) -> dict[str, dict[str, Any]]:
    """Return the frames, the pose and the last reason of each further camera.

    The pose of a fixed camera is T_world_camera, that of a carried one T_first_camera; a free camera has none.
    """
    return {name: _metrics([row for row in rows if row.camera_name == name], cameras[name]) for name in cameras}


def _metrics(rows: Sequence[FrameRow], camera: FurtherCamera) -> dict[str, Any]:
    lost = [row for row in rows if row.verdict == "lost"]
    counts = {
        "frames": len(rows),
        "tracked": sum(row.tracked for row in rows),
        "keyframes": sum(row.keyframe for row in rows),
        "reason": "; ".join(lost[-1].reasons) if lost else None,
    }
    if not isinstance(camera, MountedCamera):
        return {"kind": "free", **counts, "pose": None}
    T, sigma = camera.pose.T_parent_camera, np.sqrt(np.diag(camera.pose.covariance))
    pose = {
        "translation": T[:3, 3].tolist(),
        "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist(),
        "translation_sigma": float(sigma[:3].max()),
        "rotation_sigma": float(sigma[3:].max()),
    }
    return {"kind": "carried" if camera.carried else "fixed", **counts, "pose": pose if camera.pose.known else None}


def camera_rows(cameras: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return the name and a summary of each further camera of :func:`camera_metrics`.

    The summary has its frames, and the standard deviation of an estimated pose or the reason why that is unknown.
    """
    rows = []
    for name, camera in cameras.items():
        text, pose = f"{camera['kind']}, {camera['tracked']} of {camera['frames']} frames", camera["pose"]
        if pose is not None and pose["translation_sigma"] > 0:
            text += f", pose ± {metres(pose['translation_sigma'])}, {degrees(pose['rotation_sigma'])}"
        elif camera["tracked"] == 0 and camera["reason"]:
            text += f": {camera['reason']}"
        rows.append((name, text))
    return rows
