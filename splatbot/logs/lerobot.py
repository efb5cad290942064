"""LeRobot datasets of version 3 with depth (LeRobot 0.6, LeRobotDataset); a log is one of their episodes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.geometry import pose_from_quat
from splatbot.logs.address import join_address
from splatbot.logs.base import MILLIMETRES, StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.joints import JointStates
from splatbot.logs.lerobot_camera import find_cameras
from splatbot.logs.lerobot_images import EmbeddedImages
from splatbot.logs.lerobot_info import read_episode, read_info
from splatbot.logs.lerobot_tables import read_columns
from splatbot.logs.lerobot_video import VideoFrames
from splatbot.logs.poses import reference, rigid_pose
from splatbot.logs.rgbd import FolderLog, RgbdReader
from splatbot.trajectory import Trajectory

OPTIONS = ("episode", "color", "depth")
STATE, POSE, STAMP = "observation.state", "splatbot.camera_pose", "splatbot.stamp"
POSE_NAMES = ["x", "y", "z", "qw", "qx", "qy", "qz"]
_POSITION = ".pos"  # that LeRobot appends to the names of joints
_MAX_STAMP = 1e12  # [s]
_AGAIN = "copy or download the dataset again"


class LeRobotLog(FolderLog, StampedLog):
    """An episode of a dataset; colour and depth are images or videos, with one camera or registered to depth.

    Joints are the column `observation.state`. Two columns of splatbot are optional: `splatbot.stamp` holds stamps [s]
    that replace `timestamp`, and `splatbot.camera_pose` reference poses T_world_camera.

    Args:
        folder: of the dataset.
        options: keys of colour and depth, by `color` and `depth`, and the number `episode`, by default 0.
        camera: camera of both images; see :func:`splatbot.logs.lerobot_camera.find_cameras`.
        joint_delay: time [s] by which the stamps of joint positions are later than their motion.

    Raises:
        LogError: an option or a file is wrong, or the dataset has no depth.
        CameraError: there are no usable intrinsics.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        options: dict[str, str] | None = None,
        camera: str | Path | Calibration | None = None,
        joint_delay: float = 0.0,
    ) -> None:
        super().__init__(folder)
        given = options or {}
        self.uri = join_address(self.folder, given)
        self._joint_delay = joint_delay
        self.info = read_info(self.folder)
        self.episode = _number(self.uri, given.get("episode", "0"))
        self.name = f"{self.name}_{self.episode:03d}"
        self._color_key, self._depth_key = self.info.choose_cameras(given.get("color"), given.get("depth"))
        keys = (self._color_key, self._depth_key)
        videos = [key for key in keys if self.info.features[key]["dtype"] == "video"]
        self._place = read_episode(self.info, self.episode, videos)
        self._rows = self._read_rows()
        self.stamps = self._stamps()
        units = self.info.depth_units(self._depth_key)
        is_fine = self._depth_key in videos or units == 1
        found, self._registration = find_cameras(self.folder, camera)
        self._reader = RgbdReader(replace(found, depth_scale=1.0 if is_fine else MILLIMETRES))
        size = (found.camera.width, found.camera.height)
        color_size = size if self._registration is None else self._registration.color_size
        self._color = self._images(self._color_key, color_size)
        self._depth = self._images(self._depth_key, size, units)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses T_world_camera of the dataset; frames whose pose is not finite or not rigid lack one."""
        return reference(self.stamps, map(_pose, self._rows[POSE])) if POSE in self._rows else None

    @cached_property
    def _joints(self) -> JointStates:
        positions: Iterable[NDArray[np.float64]] = self._rows.get(STATE, ())
        names = _joint_names(self.info.features.get(STATE, {}))
        return JointStates(
            (stamp, names if len(names) == len(row) else (), row)
            for stamp, row in zip(self.stamps, positions, strict=False)
        )

    def _decode(self, index: int) -> Frame:
        color, depth = (
            Path(f"{self.folder} (episode {self.episode}, {key}, frame {index})")
            for key in (self._color_key, self._depth_key)
        )
        rgb, z = self._color.color(index, color), self._depth.depth(index, depth)
        if self._registration is not None:
            rgb, z = self._registration.register(rgb, z, color)
        try:
            frame = self._reader.frame(index, self.stamps[index], rgb, z, color, depth)
        except LogError as error:
            if error.field != "depth_scale":
                raise
            field = f"features.{self._depth_key}.info.depth_unit"
            raise self.info.bad(field, "makes the first depth image implausible", 'write "m" or "mm"') from error
        names, joints = self._joints.at(frame.stamp + self._joint_delay) or ((), None)
        return replace(frame, joints=joints, joint_names=names)

    def _read_rows(self) -> dict[str, NDArray[Any]]:
        """Return the columns of the episode, and the rows that it takes in the file as `row`."""
        path, length = self._place.data, self._place.length
        rows = read_columns(
            path,
            integers=("episode_index", "frame_index", "index"),
            numbers=("timestamp", *([STAMP] if STAMP in self.info.features else [])),
            vectors=[name for name in (STATE, POSE) if name in self.info.features],
        )
        own = np.flatnonzero(rows["episode_index"] == self.episode)
        rows = {name: column[own] for name, column in rows.items()} | {"row": own}
        for name, first in (("frame_index", 0), ("index", self._place.first)):
            if not np.array_equal(rows[name], np.arange(first, first + length)):
                problem = f"does not count the {length} frames of episode {self.episode} from {first}."
                raise LogError(problem, file=path, field=name, hint=_AGAIN)
        if POSE in rows and rows[POSE].shape[1] != len(POSE_NAMES):
            hint = f"write {', '.join(POSE_NAMES)}"
            raise LogError(f"has {rows[POSE].shape[1]} values a frame.", file=path, field=POSE, hint=hint)
        return rows

    def _stamps(self) -> list[float]:
        for name in ("timestamp", *([STAMP] if STAMP in self._rows else [])):
            stamps = self._rows[name]
            if not (np.abs(stamps) < _MAX_STAMP).all() or not (np.diff(stamps) > 0).all():
                hint = "write the times of the frames [s], in their order"
                raise LogError("is not increasing.", file=self._place.data, field=name, hint=hint)
        return [float(stamp) for stamp in stamps]

    def _images(self, key: str, size: tuple[int, int], units: float | None = None) -> EmbeddedImages | VideoFrames:
        if key not in self._place.videos:
            return EmbeddedImages(self._place.data, key, self._rows["row"], size, units)
        path, start = self._place.videos[key]
        codes = self.info.depth_codes(key)
        return VideoFrames(path, start + self._rows["timestamp"], 0.25 / self.info.fps, size, codes)


def _number(uri: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise LogError(f"is {text!r:.40}.", file=uri, field="episode", hint="give a number: DATASET?episode=3")
    return int(text)


def _joint_names(feature: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of the joints, or none if the dataset does not name each."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:  # as {"motors": [...]}
        (names,) = names.values()
    if not isinstance(names, list) or len({str(name) for name in names}) != len(names):
        return ()
    return tuple(str(name).removesuffix(_POSITION) for name in names)


def _pose(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    try:
        return rigid_pose(pose_from_quat(values[:3], values[3:]))
    except ValueError:  # a quaternion of zeros or NaN
        return None
