"""Recordings of ROS topics: a bare `.mcap`, a rosbag2 folder or a ROS 1 `.bag`, through rosbags."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from splatbot.camera import Camera
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.imu import ImuSamples
from splatbot.logs.address import PAIR_WITHIN, join_address, seconds_of_option
from splatbot.logs.base import MILLIMETRES, StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.index import MAX_STAMP_DIFFERENCE_S, associate
from splatbot.logs.joints import JointStates
from splatbot.logs.mcap import COLOR, DEPTH, INFO, JOINTS, MASK, TRUTH
from splatbot.logs.mcap_storage import check_checksums
from splatbot.logs.presets import find_calibration
from splatbot.logs.ros_cameras import CameraPair, RosCameras
from splatbot.logs.ros_frames import (
    COLOR_ENCODINGS,
    DEPTH_ENCODINGS,
    RosFrame,
    camera_of,
    color_of,
    depth_of,
    mask_of,
    pose_of,
    seconds_of,
    to_nanoseconds,
)
from splatbot.logs.ros_imu import TYPE as IMU
from splatbot.logs.ros_imu import RecordedImu
from splatbot.logs.ros_transforms import TF, TF_STATIC, StampedTransform, static_transform, transforms_of
from splatbot.logs.ros_types import Message, typestore
from splatbot.logs.streams import bag_streams, header_stamp, obstacle_to_mapping
from splatbot.protocols import Array
from splatbot.trajectory import Trajectory

KEYS = ("color", "depth", "info", "joints", "registered", PAIR_WITHIN)
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_BEFORE_FIRST_S = 0.05
_T = TypeVar("_T")

_log = logging.getLogger(__name__)


def _info_of(topic: str) -> str:
    """Return the topic of the CameraInfo next to an image topic."""
    return f"{topic.removesuffix('/compressed').removesuffix('/compressedDepth').rsplit('/', 1)[0]}/camera_info"


@dataclass(frozen=True)
class _Entry:
    """A message: header stamp [s], receive time [ns], and its index among messages with the same receive time."""

    stamp: float
    received: int
    nth: int


class BagLog(StampedLog):
    """RGB-D frames of a recording of ROS topics; each depth image is paired with the colour image nearest in time.

    Colour images without depth within 0.02 s, or the option `pair_within`, are skipped and counted in ``unpaired``. If
    recorded, joint positions are read from /joint_states, masks (white pixels are valid) from /camera/mask/image_raw
    and reference poses from /ground_truth/pose. Imu topics give the samples of the IMU, if /tf_static connects their
    frames to the camera. Frames are :class:`splatbot.logs.ros_frames.RosFrame`; they are decoded on access, and the
    file stays open. The class is not thread-safe.

    Where depth is of another camera by its frame_id or size, colour is put at its pixels. Its camera_info and
    /tf_static describe the two cameras (:class:`splatbot.logs.ros_cameras.CameraPair`).

    Args:
        path: the file or folder.
        camera: intrinsics that replace the recorded CameraInfo.
        options: topics to read by the keys `color`, `depth`, `info` and `joints`, needed if the recording has several.
            `pair_within` is the largest difference [s] of the stamps of a pair. `registered=1` states that depth
            is registered to colour, against its headers.
        joint_delay: time [s] by which the stamps of joint positions are later than their motion.

    Raises:
        LogError: the file is missing or damaged, a topic is missing or ambiguous, or nothing can be paired. Depth is of
            another camera, whose intrinsics or place are not recorded.
        CameraError: there are no usable intrinsics.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        camera: str | Path | Calibration | None = None,
        options: dict[str, str] | None = None,
        joint_delay: float = 0.0,
    ) -> None:
        self.path, self._joint_delay, self._given = Path(path), joint_delay, dict(options or {})
        self._pair_within = seconds_of_option(self.path, self._given, MAX_STAMP_DIFFERENCE_S)
        self.uri = join_address(self.path, self._given)
        self.name = self.path.stem
        self._reader = self._open()
        self._color, self._depth = self._image_topics()
        self._index = self._scan()
        self._pairs = self._pair()
        self.stamps = [color.stamp for color, _ in self._pairs]
        self.unpaired = len(self._index[self._color]) - len(self._pairs)
        self._calibration = (
            find_calibration(camera) if camera is not None else Calibration(self._recorded_camera(), MILLIMETRES)
        )
        self._cameras = self._camera_pair()

    @property
    def camera(self) -> Camera:
        """Camera of the delivered frames: undistorted."""
        return self._cameras.camera

    @property
    def calibration(self) -> Calibration:
        """The given calibration, or the recorded intrinsics."""
        return self._calibration

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses T_world_camera of /ground_truth/pose, or None without that topic."""
        if TRUTH not in self._reader.topics:
            return None
        messages = list(self._all(TRUTH))
        poses = self._checked(TRUTH, lambda: np.stack([pose_of(m.pose) for m in messages]))
        return Trajectory(np.array([seconds_of(m.header.stamp) for m in messages]), poses)

    def accelerations(self) -> dict[str, NDArray[np.float64]]:
        """Return stamps [s] and specific forces [m/s²] (N, 4) of each topic of sensor_msgs/Imu that has them."""
        return self._imu_messages.accelerations()

    @cached_property
    def imu(self) -> ImuSamples | None:
        """Samples of the whole recording in the axes of the frames; None if no Imu topic has known axes."""
        return self._imu_messages.samples(self._camera_frame, self._static_transform)

    @property
    def has_transforms(self) -> bool:
        """Return whether the recording has messages of TF."""
        return any(c.topic in (TF, TF_STATIC) and c.msgcount for c in self._reader.connections)

    def transforms(self) -> Iterator[StampedTransform]:
        """Yield the transforms of /tf_static, then those of /tf, in the order of their receive times."""
        for topic in (TF_STATIC, TF):
            for message in self._all(topic):
                yield from transforms_of(message, static=topic == TF_STATIC)

    def _decode(self, index: int) -> Frame:
        color, depth = self._pairs[index]
        message = self._checked(self._color, lambda: self._read(self._color, color))
        rgb = self._checked(self._color, lambda: color_of(message))
        z = self._checked(self._depth, lambda: depth_of(self._read(self._depth, depth)))
        mask = self._mask(color.stamp)
        where = f"{self.path} {self._color} {index}"
        names, joints = self._joints.at(color.stamp + self._joint_delay) or ((), None)
        moved = joints is not None and depth.stamp != color.stamp
        try:
            rgb, z = self._cameras.images(rgb, z)
            return RosFrame(
                color.stamp,
                rgb,
                z,
                self._cameras.camera,
                index,
                joints=joints,
                mask=None if mask is None else self._cameras.mask(mask),
                source=where,
                depth_delay=depth.stamp - color.stamp,
                joint_names=names,
                camera_frame=self._camera_frame,
                imu=self._imu_samples(index),
                depth_joints=self._joints.of(names, depth.stamp + self._joint_delay) if moved else None,
            )
        except InputError as error:
            raise LogError(error.message, file=where, field=error.field, hint=error.hint) from error

    @cached_property
    def _imu_messages(self) -> RecordedImu:
        """The Imu messages, which are read when the first frame needs them; none if one is damaged."""
        found = RecordedImu()
        try:
            for topic in sorted({c.topic for c in self._reader.connections if c.msgtype == IMU}):
                for message in self._all(topic):
                    found.add(topic, message)
        except LogError as error:
            _log.warning("the Imu messages are not used: %s", error)
            return RecordedImu()
        return found

    def _imu_samples(self, index: int) -> ImuSamples | None:
        """Return the samples since the frame before, or those shortly before the first frame."""
        if self.imu is None:
            return None
        stamp = self.stamps[index]
        return self.imu.between(self.stamps[index - 1] if index else stamp - _BEFORE_FIRST_S, stamp)

    def _camera_pair(self) -> CameraPair:
        """Return the cameras of colour and depth by the headers of their first messages.

        Raises:
            LogError: depth is of another camera, whose intrinsics or place are not recorded.
        """
        (color, depth), hint = self._pairs[0], f"state it, if depth is registered: {self.path.name}?registered=1"
        colors, depths = self._read(self._color, color), self._read(self._depth, depth)
        color_frame, depth_frame = (image.header.frame_id.strip("/") for image in (colors, depths))
        self._camera_frame = color_frame
        cameras = RosCameras(self._static_transform)
        cameras.color = self._calibration.camera
        same_size = color_of(colors).shape[:2] == depth_of(depths).shape
        if self._given.get("registered") == "1":
            return cameras.pair("", "", same_size=True)
        topic, of_color = _info_of(self._depth), same_size and color_frame == depth_frame
        if not of_color and (info := next(iter(self._all(topic)), None)) is not None:
            cameras.set_depth(self._checked(topic, lambda: camera_of(info)), info.header.frame_id.strip("/"))
        try:
            pair = cameras.pair(color_frame, depth_frame, same_size=same_size)
        except InputError as error:
            raise LogError(error.message, file=self.path, field=self._depth, hint=f"{error.hint}; {hint}") from error
        if MASK in self._index and not pair.one:
            raise LogError("are of colour, but depth is of another camera.", file=self.path, field=MASK, hint=hint)
        self._camera_frame = depth_frame or color_frame
        return pair

    def _static_transform(self, target: str, source: str) -> Array | None:
        messages = self._all(TF_STATIC) if TF_STATIC in self._reader.topics else ()
        found = (transform for message in messages for transform in transforms_of(message, static=True))
        return static_transform(found, target, source)

    @cached_property
    def _joints(self) -> JointStates:
        topic = self._given.get("joints", JOINTS)
        messages = self._all(topic) if topic in self._reader.topics else ()
        return JointStates(
            (seconds_of(m.header.stamp), tuple(m.name), np.asarray(m.position, np.float64)) for m in messages
        )

    def _mask(self, stamp: float) -> NDArray[np.bool_] | None:
        entry = next((e for e in self._index.get(MASK, ()) if e.stamp == stamp), None)
        return None if entry is None else self._checked(MASK, lambda: mask_of(self._read(MASK, entry)))

    def _recorded_camera(self) -> Camera:
        topic = self._given.get("info") or self._info_topic()
        first = next(iter(self._all(topic)), None)
        if first is not None:
            return self._checked(topic, lambda: camera_of(first))
        raise LogError("holds no message.", file=self.path, field=topic, hint="give --camera FILE")

    def _info_topic(self) -> str:
        sibling = _info_of(self._color)
        known = [c.topic for c in self._reader.connections if c.msgtype == "sensor_msgs/msg/CameraInfo"]
        for topic in (sibling, INFO, *(known if len(set(known)) == 1 else ())):
            if topic in known:
                return topic
        raise LogError(
            f"holds no {sibling}.", file=self.path, field="camera", hint="name it (?info=TOPIC) or give --camera FILE"
        )

    def _open(self) -> AnyReader:
        if not self.path.exists():
            raise LogError("does not exist.", file=self.path, field="log", hint="check the path")
        if self.path.is_file() and self.path.suffix == ".mcap":
            check_checksums(self.path)
        try:
            reader = AnyReader([self.path], default_typestore=typestore())
            reader.open()
        except Exception as error:  # damaged bytes raise any exception in the reader
            raise self._damaged(error) from error
        return reader

    def _image_topics(self) -> tuple[str, str]:
        kinds: dict[str, list[str]] = {"color": [], "depth": []}
        for connection in (c for c in self._reader.connections if c.msgtype in _IMAGES and c.msgcount):
            kind = self._kind(connection)
            if kind and connection.topic not in kinds[kind]:
                kinds[kind].append(connection.topic)
        color = self._choose("color", kinds["color"], (COLOR,))
        depth = self._choose("depth", kinds["depth"], (DEPTH, "aligned_depth_to_color", "depth_registered"))
        return color, depth

    def _kind(self, connection: Connection) -> str | None:
        if connection.msgtype == _IMAGES[1]:
            return "depth" if "depth" in connection.topic.lower() else "color"
        encoding = str(next(iter(self._all(connection.topic))).encoding)
        return "color" if encoding in COLOR_ENCODINGS else "depth" if encoding in DEPTH_ENCODINGS else None

    def _choose(self, key: str, topics: list[str], preferred: Iterable[str]) -> str:
        given = self._given.get(key)
        if given is not None and given in self._reader.topics:
            return given
        known = ", ".join(sorted(self._reader.topics)) or "none"
        if given is not None:
            raise LogError(f"holds no topic {given}.", file=self.path, field=key, hint=f"its topics are {known}")
        fitting = [topics, *([t for t in topics if name in t] for name in preferred)]
        for some in fitting:
            if len(some) == 1:
                return some[0]
        problem = f"several {key} topics ({', '.join(topics)})" if topics else f"no {key} images (topics: {known})"
        hint = f"name one: {self.path.name}?{key}=TOPIC"
        if not topics and (clouds := obstacle_to_mapping(bag_streams(self.path))):
            hint = clouds
        raise LogError(f"holds {problem}.", file=self.path, field=key, hint=hint)

    def _scan(self) -> dict[str, list[_Entry]]:
        """Index the images by topic, sorted by stamp, of which only headers are parsed."""
        images = (self._color, self._depth, MASK)
        wanted = [c for c in self._reader.connections if c.topic in images]
        found: dict[str, list[_Entry]] = defaultdict(list)
        seen: dict[tuple[str, int], int] = defaultdict(int)
        try:
            for connection, received, raw in self._reader.messages(wanted):
                key = connection.topic, received
                stamp = header_stamp(raw, ros2=self._reader.is2)
                found[connection.topic].append(_Entry(stamp, received, seen[key]))
                seen[key] += 1
        except Exception as error:
            raise self._damaged(error) from error
        depths = sorted(found.pop(self._depth, ()), key=lambda entry: entry.stamp)
        return {self._depth: depths} | {topic: self._distinct(topic, entries) for topic, entries in found.items()}

    def _distinct(self, topic: str, entries: list[_Entry]) -> list[_Entry]:
        """Return the entries by stamp; of those with one stamp, the first that was received."""
        first: dict[float, _Entry] = {}
        for entry in entries:
            first.setdefault(entry.stamp, entry)
        if len(first) < len(entries):
            count = len(entries) - len(first)
            _log.warning("%s: %d of %d messages of %s repeat a stamp", self.path, count, len(entries), topic)
        return sorted(first.values(), key=lambda e: e.stamp)

    def _pair(self) -> list[tuple[_Entry, _Entry]]:
        """Pair the images of one frame as splatbot records them, in others those that are nearest by their stamps."""
        colors, depths = self._index[self._color], self._index[self._depth]
        together = {entry.received: entry for entry in depths}
        own = all(entry.received in together and entry.received == to_nanoseconds(entry.stamp) for entry in colors)
        if own and len(together) == len(depths):
            return [(entry, together[entry.received]) for entry in colors]
        depths = self._distinct(self._depth, depths)
        a, b = (np.array([entry.stamp for entry in entries]) for entries in (colors, depths))
        pairs = [(colors[i], depths[j]) for i, j in associate(a, b, self._pair_within)]
        if not pairs:
            raise LogError(
                f"no stamp of {self._depth} is within {self._pair_within:g} s of one of {self._color}.",
                file=self.path,
                field="stamps",
                hint=f"record both with the same clock, or pair more loosely: ?{PAIR_WITHIN}=0.05",
            )
        return pairs

    def _read(self, topic: str, entry: _Entry) -> Message:
        of_topic = [c for c in self._reader.connections if c.topic == topic]
        for nth, (connection, _, raw) in enumerate(
            self._reader.messages(of_topic, start=entry.received, stop=entry.received + 1)
        ):
            if nth == entry.nth:
                return self._reader.deserialize(raw, connection.msgtype)
        raise LogError("a message is missing.", file=self.path, field=topic, hint="do not modify a log that is open")

    def _all(self, topic: str) -> Iterable[Message]:
        """Yield the messages of a topic in the order of their receive times."""
        of_topic = [c for c in self._reader.connections if c.topic == topic]
        if not of_topic:  # the reader yields all topics for none
            return
        try:
            for connection, _, raw in self._reader.messages(of_topic):
                yield self._reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            raise self._damaged(error) from error

    def _checked(self, topic: str, read: Callable[[], _T]) -> _T:
        """Call ``read`` and add the file and the topic to its errors."""
        try:
            return read()
        except LogError:
            raise
        except InputError as error:
            field = f"{topic} {error.field}" if error.field else topic
            raise type(error)(error.message, file=self.path, field=field, hint=error.hint) from error
        except Exception as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> LogError:
        hint = "copy the recording again, or repair it (`mcap recover`, `rosbag reindex`)"
        return LogError(f"cannot be read ({type(error).__name__}: {error}).", file=self.path, field="log", hint=hint)
