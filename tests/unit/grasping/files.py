"""Contents of files of grasps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

STANDING = {"translation": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}


def grasp_values(q: Sequence[float] | None) -> dict[str, Any]:
    """Return a grasp whose pre-grasp has these joint values."""
    joints = None if q is None else list(q)
    pose = {"position": [0.5, 0.0, 0.1], "quaternion_wxyz": [0, 1, 0, 0]}
    return {
        "T_world_tcp": pose,
        "T_world_pregrasp": pose,
        "width_m": 0.04,
        "opening_m": 0.05,
        "contacts": [[0.5, -0.02, 0.1], [0.5, 0.02, 0.1]],
        "normals": [[0, -1, 0], [0, 1, 0]],
        "contact_depth_distance_m": [None, 0.001],
        "contact_implied": [True, False],
        "finger_unseen": None,
        "approach": "top",
        "terms": {"closure": 0.8},
        "total": 0.7,
        "confidence": 0.9,
        "clearance_m": 0.01,
        "q": joints,
        "q_pregrasp": joints,
        "approach_path": None if joints is None else [joints, joints],
        "rejected": "",
    }


def grasp_file_values(*grasps: dict[str, Any], robot: str = "panda") -> dict[str, Any]:
    """Return the content of a file of grasps, at a base at the origin."""
    return {
        "target": {"label": "red box", "backend": "rules", "score": 0.9, "gaussians": 3, "notes": []},
        "grasps": list(grasps),
        "robot": robot,
        "joint_offsets": [],
        "T_world_base": STANDING,
        "margin_m": 0.0,
        "arm_margin_m": 0.01,
        "unknown_space": "free",
        "n_sigma": 1.0,
        "min_observations": 1,
        "map_sha256": "0" * 64,
        "map_gaussians": 10,
        "target_rows": [0, 1, 2],
    }
