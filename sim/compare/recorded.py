"""The arm's data in a log: tool poses, joints, and camera poses in the base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from splatbot.errors import FormatError, InputError
from splatbot.geometry import inverse, nearest_rotation, so3_log
from splatbot.logs.calibration import read_object
from splatbot.logs.joints import JointRecord, find_joints, select_joints
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace, find_workspace

TOOL_POSES = "ee_poses.txt"
_MOUNT = "ee_T_camera"
_INTRINSICS = "intrinsics.json"


@dataclass(frozen=True)
class RecordedConstants:
    """Constants of the comparison with recorded poses.

    Args:
        outlier: [median] an outlier's difference exceeds this multiple of the median.
        iterations: rounds of outlier removal.
        max_stamp_error: [s] largest difference between the stamps of a pose and a frame.
    """

    outlier: float = 3.0
    iterations: int = 4
    max_stamp_error: float = 0.01


CONSTANTS = RecordedConstants()


_TOLERANCE = np.array([1e-3, 2e-3])  # [m], [rad] differences that are never outliers


@dataclass(frozen=True, eq=False)
class ArmRecord:
    """The arm's data in a log's folder.

    Args:
        tool: T_base_tool at their own stamps. If None, they are not recorded.
        T_tool_camera: (4, 4) of the camera on the tool. If None, it is not known.
        joints: joint positions over time. If None, they are not recorded.
        workspace: scene of the log, with the mount and the joint offsets of one calibration.
    """

    tool: Trajectory | None = None
    T_tool_camera: Array | None = None
    joints: JointRecord | None = None
    workspace: Workspace = field(default_factory=Workspace)

    def tool_at(self, stamp: float) -> Array | None:
        """Return T_base_tool (4, 4) as recorded within 10 ms of a stamp [s], or None."""
        if self.tool is None or not len(self.tool):
            return None
        k = int(np.argmin(np.abs(self.tool.stamps - stamp)))
        return (
            self.tool.T_world_camera[k]
            if abs(float(self.tool.stamps[k]) - stamp) <= CONSTANTS.max_stamp_error
            else None
        )

    def camera_at(self, stamp: float, robot: RobotModel) -> Array | None:
        """Return T_base_camera (4, 4) from the tool's pose or else from the joints, or None if neither is recorded."""
        T_base_tool = self.tool_at(stamp)
        if T_base_tool is not None and self.T_tool_camera is not None:
            return np.asarray(T_base_tool @ self.T_tool_camera)
        q, mount = self.joints_at(stamp, robot), self.workspace.T_link_camera
        if q is None or mount is None:
            return None
        return np.asarray(robot.fk(q)[self.workspace.camera_link] @ mount)

    def joints_at(self, stamp: float, robot: RobotModel) -> Array | None:
        """Return the joint positions (J,) at a stamp [s], or None if they are not known.

        Raises:
            InputError: the arm in the log has another number of joints.
        """
        q = None if self.joints is None else self.joints.at(stamp)
        if q is not None and self.joints is not None and self.joints.names:
            return select_joints(self.joints.names, q, self.workspace.joint_names or robot.chain.names)
        if q is not None and len(q) != len(robot):
            raise InputError(
                f"has {len(q)} joints, {robot.name} has {len(robot)}.", field="joints.txt", hint="name the arm: --robot"
            )
        return q

    @property
    def source(self) -> str:
        """Description of the source of camera poses; empty if there is no source."""
        if self.tool is not None and self.T_tool_camera is not None:
            return f"{TOOL_POSES} and {_MOUNT} of {_INTRINSICS}"
        if self.joints is not None and self.workspace.T_link_camera is not None:
            return "joints.txt and T_link_camera of scene.yaml"
        return ""


def read_arm(folder: str | Path, run: Path | None = None) -> ArmRecord:
    """Read the arm's data from a log's folder; a log that is no folder has only a scene.

    Args:
        folder: the log.
        run: folder of a run, whose ``scene.yaml`` counts before that of the log if it has a calibration of the arm.

    Raises:
        FormatError: a file is damaged.
        LogError: `joints.txt` is damaged.
    """
    place, scene = Path(folder), _calibrated(find_workspace(run) or Workspace(), find_workspace(folder) or Workspace())
    if not place.is_dir():
        return ArmRecord(workspace=scene)
    tool = Trajectory.load(place / TOOL_POSES) if (place / TOOL_POSES).exists() else None
    return ArmRecord(tool, _mount(place / _INTRINSICS), find_joints(place), scene)


def _calibrated(run: Workspace, log: Workspace) -> Workspace:
    """Return the scene of a log with mount and joint offsets of one scene: of the first that has a mount, else offsets.

    Hand-eye calibration estimates both together.
    """
    with_offsets = run if run.joint_offsets is not None else log
    found = next((scene for scene in (run, log) if scene.T_link_camera is not None), with_offsets)
    return replace(
        log,
        T_link_camera=found.T_link_camera,
        camera_link=found.camera_link,
        joint_offsets=found.joint_offsets,
        offsets_of=found.offsets_of,
    )


@dataclass(frozen=True, eq=False)
class BaseInMap:
    """Pose of the arm's base in a map.

    Args:
        T_world_base: (4, 4).
        residuals: (F, 2) differences of the camera's pose by the arm to that by tracking [m, rad]; empty if the base
            does not come from poses.
        frames: (F,) of the log.
        left_out: frames whose two poses are inconsistent, as after a tracking failure.
        source: description of the source.
    """

    T_world_base: Array
    residuals: Array
    frames: tuple[int, ...]
    left_out: tuple[int, ...]
    source: str


def base_in_map(T_base_camera: Mapping[int, Array], T_world_camera: Mapping[int, Array], source: str) -> BaseInMap:
    """Estimate the base from one camera's poses in both frames by the mean rotation and mean position.

    The rotation is the chordal L2 mean (Hartley et al. 2013). Frames that differ from it by more than three times the
    median are outliers.

    Args:
        T_base_camera: (4, 4) by frame of the log, from the arm.
        T_world_camera: (4, 4) by frame, from tracking.
        source: description of the source of the first.

    Raises:
        InputError: no frame has both.
    """
    frames = sorted(set(T_base_camera) & set(T_world_camera))
    if not frames:
        raise InputError(
            f"has no frame in common with the arm's poses ({len(T_world_camera)} and {len(T_base_camera)} frames).",
            field="map",
            hint="give the run that mapped this log",
        )
    theirs, ours = (np.array([poses[i] for i in frames]) for poses in (T_base_camera, T_world_camera))
    kept = np.ones(len(frames), np.bool_)
    for _ in range(CONSTANTS.iterations):
        T = _between(theirs[kept], ours[kept])
        gaps = np.array([pose_gap(T @ a, b) for a, b in zip(theirs, ours, strict=True)])
        limit = np.maximum(CONSTANTS.outlier * np.median(gaps, axis=0), _TOLERANCE)
        again = (gaps <= limit).all(axis=1)
        if (again == kept).all():
            break
        kept = again if again.any() else kept
    return BaseInMap(T, gaps, tuple(frames), tuple(np.array(frames)[~kept].tolist()), source)


def _between(theirs: Array, ours: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = nearest_rotation((ours[:, :3, :3] @ theirs[:, :3, :3].transpose(0, 2, 1)).sum(axis=0))
    T[:3, 3] = (ours[:, :3, 3] - theirs[:, :3, 3] @ T[:3, :3].T).mean(axis=0)
    return T


def pose_gap(a: Array, b: Array) -> tuple[float, float]:
    """Compute the distance of two poses (4, 4) [m, rad]."""
    turn = so3_log(inverse(a)[:3, :3] @ b[:3, :3])
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.linalg.norm(turn))


def _mount(path: Path) -> Array | None:
    """Read ``ee_T_camera`` from a log's intrinsics."""
    if not path.exists():
        return None
    value = read_object(path).get(_MOUNT)
    if value is None:
        return None
    hint = "write four rows of four numbers: a rotation, and metres in the last column"
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FormatError(f"is no matrix ({error}).", file=path, field=_MOUNT, hint=hint) from error
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-4:
        raise FormatError("is no rigid pose.", file=path, field=_MOUNT, hint=hint)
    return T
