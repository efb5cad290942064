"""Grasp results as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from splatbot.geometry import pose_from_quat, rotation_to_quat
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
        "lift_blocked": grasp.lift_blocked,
    }


def grasp_from(values: Mapping[str, Any]) -> Grasp:
    """Return the grasp that :func:`summary` wrote as JSON values.

    Raises:
        KeyError, TypeError, ValueError: the values are of something else.
    """

    def pose(name: str) -> Array:
        return pose_from_quat(values[name]["position"], values[name]["quaternion_wxyz"])

    def array(name: str, *shape: int) -> Array | None:
        if values[name] is None:
            return None
        found = np.array([np.inf if x is None else x for x in values[name]], dtype=np.float64)
        if found.ndim != len(shape) or any(n not in (-1, k) for n, k in zip(shape, found.shape, strict=True)):
            raise ValueError(f"{name} has the shape {found.shape}")
        return found

    contacts, normals = array("contacts", 2, 3), array("normals", 2, 3)
    if contacts is None or normals is None:
        raise ValueError("contacts or normals are null")
    q = array("q", -1)
    joints = -1 if q is None else len(q)
    return Grasp(
        T_world_tcp=pose("T_world_tcp"),
        width=float(values["width_m"]),
        opening=float(values["opening_m"]),
        contacts=contacts,
        normals=normals,
        approach=str(values["approach"]),
        terms={str(name): float(term) for name, term in values["terms"].items()},
        total=float(values["total"]),
        clearance=float(values["clearance_m"]),
        T_world_pregrasp=pose("T_world_pregrasp"),
        q=q,
        q_pregrasp=array("q_pregrasp", joints),
        approach_path=array("approach_path", -1, joints),
        rejected=str(values["rejected"]),
        depth_distance=array("contact_depth_distance_m", 2),
        unseen=array("finger_unseen", 2),
        lift_blocked=str(values.get("lift_blocked", "")),
    )


def _finite(values: Array | None) -> list[float | None] | None:
    """Return values as JSON numbers, null for infinity; None stays None."""
    return None if values is None else [float(value) if np.isfinite(value) else None for value in values]
