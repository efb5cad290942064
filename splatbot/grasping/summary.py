"""Grasp results as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatbot.geometry import rotation_to_quat
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.protocols import Array


def summary(result: GraspResult) -> dict[str, Any]:
    """Return a result as JSON values; lengths in metres, poses as position and quaternion wxyz."""
    return {
        "target": {
            "label": result.target.label,
            "backend": result.target.backend,
            "score": result.target.score,
            "gaussians": len(result.target.rows),
            "notes": list(result.target.notes),
        },
        "grasps": [_grasp_summary(grasp) for grasp in result.grasps],
        "doubtful": [_grasp_summary(grasp) for grasp in result.doubtful],
        "best_rejected": _grasp_summary(result.best_rejected) if result.best_rejected is not None else None,
        "rejected": dict(result.rejected),
        "candidates": result.candidates,
        "notes": list(result.notes),
        "seconds": dict(result.seconds),
        "map_version": result.map_version,
    }


def _grasp_summary(grasp: Grasp) -> dict[str, Any]:
    def pose(T: Array) -> dict[str, Any]:
        return {"position": T[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist()}

    return {
        "T_world_tcp": pose(grasp.T_world_tcp),
        "T_world_pregrasp": pose(grasp.T_world_pregrasp),
        "width_m": grasp.width,
        "opening_m": grasp.opening,
        "contacts": grasp.contacts.tolist(),
        "normals": grasp.normals.tolist(),
        "contact_depth_distance_m": _finite(grasp.depth_distance),
        "contact_implied": list(grasp.implied) if grasp.depth_distance is not None else None,
        "finger_unseen": None if grasp.unseen is None else grasp.unseen.round(3).tolist(),
        "approach": grasp.approach,
        "terms": dict(grasp.terms),
        "total": grasp.total,
        "confidence": grasp.confidence,
        "clearance_m": grasp.clearance,
        "q": grasp.q.tolist() if grasp.q is not None else None,
        "q_pregrasp": grasp.q_pregrasp.tolist() if grasp.q_pregrasp is not None else None,
        "approach_path": grasp.approach_path.tolist() if grasp.approach_path is not None else None,
        "rejected": grasp.rejected,
    }


def _finite(values: Array | None) -> list[float | None] | None:
    """Return values as JSON numbers, null for infinity; None stays None."""
    return None if values is None else [float(value) if np.isfinite(value) else None for value in values]
