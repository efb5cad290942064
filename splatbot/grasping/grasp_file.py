"""Files of grasps, which `splatbot grasp` writes and plans and picks read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.collision.unknown import UnknownPolicy
from splatbot.errors import FormatError, InputError
from splatbot.geometry import pose_from_quat, rotation_to_quat
from splatbot.grasping.affordance import Target
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.summary import grasp_from, summary
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.protocols import Array
from splatbot.workspace import same_offsets

_HINT = "give the grasp.json of `splatbot grasp`"
_AGAIN = "search for grasps again, in this map"


@dataclass(frozen=True, eq=False)
class GraspFile:
    """Content of a file of grasps.

    Args:
        path: the file.
        robot: name of the robot.
        joint_offsets: (J,) offsets of its joints in the scene [rad or m]; empty without them.
        T_world_base: (4, 4) pose of its base [m].
        target: the target; its rows are those of the map without flying pixels.
        gaussians: number of rows of that map.
        grasps: grasps, best first.
        failure: without grasps, the reason and the change to try first.
        margin, arm_margin: clearance [m] of the whole arm, and of the links before the hand.
        unknown: treatment of unknown space.
        measured: whether measured surface that the map lacks is an obstacle of plans.
        n_sigma: surface of a Gaussian, in standard deviations.
        min_observations: least number of keyframes that support a Gaussian.
        map_sha256: hash of the map's file.
    """

    path: Path
    robot: str
    joint_offsets: Array
    T_world_base: Array
    target: Target
    gaussians: int
    grasps: tuple[Grasp, ...]
    failure: tuple[str, str]
    margin: float
    arm_margin: float
    unknown: UnknownPolicy
    measured: bool
    n_sigma: float
    min_observations: int
    map_sha256: str

    @classmethod
    def load(cls, path: Path) -> GraspFile:
        """Read a file.

        Raises:
            FormatError: the file is no such file.
        """
        try:
            return cls._from(path, json.loads(path.read_text()))
        except (ValueError, TypeError, KeyError, UnicodeDecodeError) as error:
            raise FormatError(f"is no file of grasps ({error!r}).", file=path, hint=_HINT) from error

    @classmethod
    def _from(cls, path: Path, values: Mapping[str, Any]) -> GraspFile:
        base, target = values["T_world_base"], values["target"]
        rows, gaussians = np.array(values["target_rows"], dtype=np.int64), int(values["map_gaussians"])
        if rows.ndim != 1 or not len(rows) or rows.min() < 0 or rows.max() >= gaussians:
            raise ValueError(f"target_rows are no rows of {gaussians} Gaussians")
        if values["unknown_space"] not in ("free", "cautious", "occupied"):
            raise ValueError(f"unknown_space is {values['unknown_space']!r}")
        return cls(
            path=path,
            robot=str(values["robot"]),
            joint_offsets=np.array(values["joint_offsets"], dtype=np.float64),
            T_world_base=pose_from_quat(base["translation"], base["quaternion_wxyz"]),
            target=Target(
                rows,
                None,
                str(target["label"]),
                str(target["backend"]),
                float(target["score"]),
            ),
            gaussians=gaussians,
            grasps=tuple(grasp_from(grasp) for grasp in values["grasps"]),
            failure=_failure_of(values),
            margin=float(values["margin_m"]),
            arm_margin=float(values["arm_margin_m"]),
            unknown=values["unknown_space"],
            measured=bool(values.get("measured_surface", False)),  # earlier versions had no such obstacles
            n_sigma=float(values["n_sigma"]),
            min_observations=int(values["min_observations"]),
            map_sha256=str(values["map_sha256"]),
        )

    def check_robot(self, name: str, T_world_base: Array) -> None:
        """Check that the grasps are of a robot at a base (4, 4).

        Raises:
            InputError: they are of another robot or another base.
        """
        if self.robot != name:
            hint = f"give --robot {self.robot}"
            raise InputError(f"has grasps of {self.robot}, not {name}.", file=self.path, field="robot", hint=hint)
        if not np.allclose(self.T_world_base, T_world_base, rtol=0.0, atol=1e-6):
            hint = "give the --base of the grasps"
            raise InputError("is another base.", file=self.path, field="T_world_base", hint=hint)

    def check_offsets(self, joint_offsets: Sequence[float]) -> None:
        """Check that the grasps are of an arm with these joint offsets (J,) [rad or m].

        Raises:
            InputError: they are of an earlier calibration of the arm.
        """
        if not same_offsets(self.joint_offsets, joint_offsets):
            text = "differ from those of the scene: the arm was calibrated since."
            raise InputError(text, file=self.path, field="joint_offsets", hint=_AGAIN)

    def check_map(self, file: Path) -> None:
        """Check that the grasps are of a map's file.

        Raises:
            InputError: the map is another one, or it changed since.
        """
        if self.map_sha256 != sha256(file):
            raise InputError("is of another map, or the map changed.", file=self.path, field="map_sha256", hint=_AGAIN)

    def check_rows(self, gaussians: int) -> None:
        """Check the number of Gaussians without flying pixels, to which the rows of the target refer.

        Raises:
            InputError: it differs, as after the recording of the run became unreadable.
        """
        if self.gaussians != gaussians:
            text = f"are of {self.gaussians} Gaussians without flying pixels; there are {gaussians} now."
            raise InputError(text, file=self.path, field="target_rows", hint=_AGAIN)

    def grasp(self, index: int, joints: int) -> Grasp:
        """Return the grasp of a rank, from 0, of a robot with this number of joints.

        Raises:
            InputError: there is no grasp, none of this rank, or it has no joint values.
        """
        if not self.grasps:
            reason, change = self.failure
            text = f"holds no grasp of {self.target.label}: {reason}."
            raise InputError(text, file=self.path, field="grasps", hint=f"{change}; then run splatbot grasp again")
        if not 0 <= index < len(self.grasps):
            hint = f"give 0 to {len(self.grasps) - 1}"
            raise InputError(f"is {index}, of {len(self.grasps)} grasps.", field="--grasp-index", hint=hint)
        found = self.grasps[index]
        q = found.q_pregrasp
        if q is None or len(q) != joints or not np.isfinite(q).all():
            hint = "search without --hand-only"
            raise InputError("has no joint values.", file=self.path, field="q_pregrasp", hint=hint)
        return found

    def result(self, index: int | None, joints: int) -> GraspResult:
        """Return the grasps, or that of one rank, as the result of a search; for errors see :meth:`grasp`."""
        ranks = range(max(1, len(self.grasps))) if index is None else (index,)
        grasps = tuple(self.grasp(rank, joints) for rank in ranks)
        return GraspResult(self.target, grasps, {}, None, len(grasps), {}, map_version=0, first_rank=ranks[0])


def grasp_file(
    result: GraspResult,
    sampler: GraspSampler,
    map_file: Path,
    *,
    robot: str,
    joint_offsets: Sequence[float],
    unknown: UnknownPolicy,
    measured: bool,
    failure: tuple[str, str] | None,
) -> dict[str, Any]:
    """Return the content of a file of grasps as JSON values.

    Args:
        result: of the search.
        sampler: with which it was made.
        map_file: the map.
        robot: name of the robot.
        joint_offsets: (J,) offsets of its joints in the scene [rad or m]; empty without them.
        unknown: treatment of unknown space.
        measured: whether measured surface that the map lacks is an obstacle of plans.
        failure: without grasps, the reason and the change to try first.
    """
    T = sampler.scene.T_world_base
    return summary(result) | {
        "robot": robot,
        "joint_offsets": list(joint_offsets),
        "T_world_base": {"translation": T[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist()},
        "margin_m": sampler.margin,
        "arm_margin_m": max(sampler.margin, sampler.arm_margin),
        "unknown_space": unknown,
        "measured_surface": measured,
        "n_sigma": sampler.n_sigma,
        "min_observations": sampler.min_observations,
        "map_sha256": sha256(map_file),
        "map_gaussians": len(sampler.scene.model),
        "target_rows": result.target.rows.tolist(),
        "failure": None if failure is None else {"reason": failure[0], "change": failure[1]},
    }


def _failure_of(values: Mapping[str, Any]) -> tuple[str, str]:
    """Return the reason and the change of a search without grasps; earlier versions wrote neither."""
    failure = values.get("failure")
    if failure is None:
        return "the search found none", "give another target or hand"
    return str(failure["reason"]), str(failure["change"])


def sha256(file: Path) -> str:
    """Return the SHA-256 hash of a file."""
    with file.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
