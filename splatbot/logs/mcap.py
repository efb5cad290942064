"""Write messages of any topics into one MCAP file (CDR and ros2msg, as ROS 2 and Foxglove read it)."""

from __future__ import annotations

import math
import shutil
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin

from splatbot.atomic import replace, sync
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.base import Log
from splatbot.logs.mcap_storage import CheckedStorage, CheckedWriter, recover, write_checksums
from splatbot.logs.record import Progress
from splatbot.logs.ros_frames import (
    camera_info_message,
    image_message,
    joint_state_message,
    pose_stamped_message,
    to_nanoseconds,
)
from splatbot.logs.ros_imu import imu_messages
from splatbot.logs.ros_types import Message, to_cdr, type_of, typestore

COLOR, DEPTH, INFO = "/camera/color/image_raw", "/camera/depth/image_raw", "/camera/color/camera_info"
MASK, JOINTS, TRUTH = "/camera/mask/image_raw", "/joint_states", "/ground_truth/pose"


class McapFile(AbstractContextManager["McapFile"]):
    """Writer of a recording; the file appears under its name only when it is complete.

    Until then the messages are in the folder `.NAME.partial` next to it. After a crash the next recording of that name
    first recovers its messages into `NAME.recovered-N.mcap`.

    Args:
        path: the file.
        overwrite: replace an existing file, when the new one is complete.

    Raises:
        LogError: the file exists, another process records into it, or its folder cannot be written to.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._partial = self.path.with_name(f".{self.path.name}.partial")
        if self.path.exists() and not overwrite:
            raise LogError("exists already.", file=self.path, hint="choose another name")
        self._topics: dict[tuple[str, str], Any] = {}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            recover(self._partial, self.path)
            self._writer = CheckedWriter(self._partial, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except OSError as error:
            raise LogError(f"cannot be written ({error.strerror}).", file=self.path, hint="check the folder") from error

    def write(self, topic: str, message: Message, nanoseconds: int) -> None:
        """Add a message that was received at a time [ns].

        Raises:
            OSError: the disk is full or not available.
        """
        name = type_of(message)
        if (topic, name) not in self._topics:
            self._topics[topic, name] = self._writer.add_connection(topic, name, typestore=typestore())
        self._writer.write(self._topics[topic, name], nanoseconds, to_cdr(message))
        self.flush_due()

    def flush_due(self) -> None:
        """Write the waiting messages to the disk if the last flush was more than a second ago.

        Raises:
            OSError: the disk is full or not available.
        """
        if isinstance(self._writer.storage, CheckedStorage):
            self._writer.storage.flush_due()

    def close(self) -> None:
        """Write the index and give the file its name."""
        self._writer.close()
        (made,) = self._partial.glob("*.mcap")
        with made.open("r+b") as file:
            write_checksums(file)
            sync(file)
        replace(made, self.path)
        shutil.rmtree(self._partial)

    def __exit__(self, kind: type[BaseException] | None, _error: object, _trace: TracebackType | None) -> None:
        self.close()


def recover_mcap(path: str | Path) -> None:
    """Give the recording that a killed process left its name, if there is one and no file has the name.

    Raises:
        LogError: another process records into it.
        OSError: the folder cannot be written to.
    """
    wanted = Path(path)
    partial = wanted.with_name(f".{wanted.name}.partial")
    if not wanted.exists() and partial.exists():
        recover(partial, wanted, name=wanted)


def record_mcap(log: Log, path: str | Path, *, progress: Progress | None = None) -> Path:
    """Write a log's frames, intrinsics, joints, masks and reference poses; reading returns bit-identical frames.

    Depth is 32FC1 [m], so nothing is rounded, and samples of the IMU are float64. Stamps are kept to the nanosecond.

    Args:
        progress: called with the number of frames written so far.

    Raises:
        LogError: the file exists, or a frame of the log cannot be read.
    """
    truth = log.ground_truth
    with McapFile(path) as out:
        for stamp, T in [] if truth is None else zip(truth.stamps.tolist(), truth.T_world_camera, strict=True):
            out.write(TRUTH, pose_stamped_message(stamp, T, "world"), to_nanoseconds(stamp))
        for number, frame in enumerate(log, 1):
            write_frame(out, frame)
            if progress is not None:
                progress(number)
    return out.path


def write_frame(out: McapFile, frame: Frame) -> None:
    """Add the intrinsics, images, mask, joints and IMU samples of a frame.

    Raises:
        OSError: the disk is full or not available.
    """
    at = to_nanoseconds(frame.stamp)
    for sampled, topic, message in () if frame.imu is None else imu_messages(frame.imu):
        out.write(topic, message, sampled)
    out.write(INFO, camera_info_message(frame.stamp, frame.camera), at)
    out.write(COLOR, image_message(frame.stamp, frame.rgb), at)
    out.write(DEPTH, image_message(frame.stamp + frame.depth_delay, frame.depth), at)
    if frame.mask is not None:
        out.write(MASK, image_message(frame.stamp, frame.mask), at)
    if frame.joints is not None:
        out.write(JOINTS, joint_state_message(frame.stamp, frame.joints, frame.joint_names), at)
    if frame.depth_joints is not None and frame.depth_delay:
        known = [k for k, q in enumerate(frame.depth_joints.tolist()) if math.isfinite(q)]
        names = tuple(frame.joint_names[k] for k in known if frame.joint_names)
        later = joint_state_message(frame.stamp + frame.depth_delay, frame.depth_joints[known], names)
        out.write(JOINTS, later, at)
