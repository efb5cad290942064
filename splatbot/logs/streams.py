"""Streams of a recording: rates, gaps, duplicates, order and clocks, from the stamps of all messages."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from splatbot.errors import InputError, LogError
from splatbot.layouts import log_kind
from splatbot.logs.index import read_index
from splatbot.logs.joints import NAME as JOINTS
from splatbot.logs.joints import find_joints
from splatbot.logs.ros_frames import camera_of
from splatbot.logs.ros_types import Message, typestore
from splatbot.protocols import Array

_SHOWN = 6  # names in a note
_POINT_CLOUD = "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True)
class Stream:
    """One stream of a recording.

    Args:
        name: topic or file.
        kind: type of its messages.
        count: number of messages.
        rate: [Hz], or None of fewer than two messages or of a single time.
        dropped: messages that are missing at the median period.
        duplicates: messages with the stamp of another one.
        out_of_order: messages that are stored after a later one.
        clock_offset: median time [s] from a stamp to its reception, or None if only one of them is recorded.
        note: size, encoding, frames or names of its first message.
    """

    name: str
    kind: str
    count: int
    rate: float | None
    dropped: int
    duplicates: int
    out_of_order: int
    clock_offset: float | None = None
    note: str = ""


def describe_stream(name: str, kind: str, stamps: Array, received: Array | None = None, *, note: str = "") -> Stream:
    """Return the statistics of stamps (N,) [s] in their stored order, with the times of reception (N,) [s] if known."""
    ordered = np.sort(stamps)
    steps = np.diff(ordered)
    distinct = steps[steps > 0]
    dropped, rate = 0, None
    if len(distinct):
        dropped = int(np.maximum(np.rint(distinct / np.median(distinct)) - 1, 0).sum())
        rate = float(len(distinct) / distinct.sum())
    late = int((stamps[1:] < np.maximum.accumulate(stamps)[:-1]).sum())
    offset = float(np.median(received - stamps)) if received is not None and len(stamps) else None
    return Stream(name, kind, len(stamps), rate, dropped, int((steps == 0).sum()), late, offset, note)


def log_streams(uri: str | Path) -> list[Stream]:
    """Read the streams of a recording; empty for kinds whose images have no stamps of their own.

    Raises:
        LogError: the recording is missing or damaged.
    """
    kind = log_kind(uri)
    path = str(uri).partition("?")[0]
    return bag_streams(path) if kind == "bag" else tum_streams(path) if kind == "tum" else []


def bag_streams(path: str | Path) -> list[Stream]:
    """Read the streams of a recording of ROS topics; only stamps and the first message of a topic are parsed.

    Raises:
        LogError: the recording is missing or damaged.
    """
    place = Path(path)
    if not place.exists():
        raise LogError("does not exist.", file=place, field="log", hint="check the path")
    try:
        with AnyReader([place], default_typestore=typestore()) as reader:
            return _read_streams(reader)
    except Exception as error:  # damaged bytes raise any exception in the reader
        hint = "copy the recording again, or repair it (`mcap recover`, `rosbag reindex`)"
        raise LogError(f"cannot be read ({type(error).__name__}: {error}).", file=place, hint=hint) from error


def tum_streams(folder: str | Path) -> list[Stream]:
    """Read the streams of a folder in TUM layout from its lists.

    Raises:
        LogError: rgb.txt, depth.txt or joints.txt is damaged.
    """
    place = Path(folder)
    images = {name: np.array([entry.stamp for entry in read_index(place / name)]) for name in ("rgb.txt", "depth.txt")}
    found = [describe_stream(name, "image list", stamps) for name, stamps in images.items()]
    joints = find_joints(place)
    if joints is not None:
        note = _some(list(joints.names)) or f"{joints.joints.shape[1]} joints without names"
        found.append(describe_stream(JOINTS, "joint positions", joints.stamps, note=note))
    return found


def obstacle_to_mapping(streams: Iterable[Stream]) -> str:
    """Return one sentence about streams that show surfaces and cannot be mapped, or nothing."""
    if not any(stream.kind == _POINT_CLOUD and stream.count for stream in streams):
        return ""
    return (
        "Point clouds cannot be mapped: splatbot maps colour images with depth; record the images of the camera and "
        "their CameraInfo."
    )


def header_stamp(raw: bytes, *, ros2: bool) -> float:
    """Return the stamp [s] of a serialized message that begins with a std_msgs/Header."""
    if not ros2:
        _seq, sec, nanosec = struct.unpack_from("<III", raw)
    else:
        sec, nanosec = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return float((sec * 10**9 + nanosec) / 10**9)


def _read_streams(reader: AnyReader) -> list[Stream]:
    kinds: dict[str, str] = {c.topic: c.msgtype for c in reader.connections}
    stamped = {topic for topic, kind in kinds.items() if _has_header(reader, kind)}
    times: dict[str, list[tuple[float, float]]] = {topic: [] for topic in kinds}
    notes: dict[str, str] = {}
    for connection, received, raw in reader.messages():
        topic, at = connection.topic, received / 1e9
        times[topic].append((header_stamp(raw, ros2=reader.is2) if topic in stamped else at, at))
        if topic not in notes:
            notes[topic] = _note(reader, connection, raw)
    found = []
    for topic in sorted(kinds):
        table: NDArray[np.float64] = np.array(times[topic], np.float64).reshape(-1, 2)
        received_at = table[:, 1] if topic in stamped else None
        found.append(describe_stream(topic, kinds[topic], table[:, 0], received_at, note=notes.get(topic, "")))
    return found


def _has_header(reader: AnyReader, kind: str) -> bool:
    fields = reader.typestore.fielddefs.get(kind, ([], []))[1]
    return bool(fields) and fields[0][0] == "header"


def _note(reader: AnyReader, connection: Connection, raw: bytes) -> str:
    describe = _NOTES.get(connection.msgtype)
    if describe is None:
        return ""
    try:
        return describe(reader.deserialize(raw, connection.msgtype))
    except (InputError, AttributeError, ValueError) as error:
        return f"first message unreadable ({error})"


def _camera_note(message: Message) -> str:
    camera = camera_of(message)
    model = message.distortion_model or "no distortion"
    return f"{camera.width}x{camera.height}, fx {camera.fx:.1f}, fy {camera.fy:.1f}, {model}"


def _tf_note(message: Message) -> str:
    return _some([f"{t.header.frame_id} > {t.child_frame_id}" for t in message.transforms])


def _cloud_note(message: Message) -> str:
    names = _some([field.name for field in message.fields])
    return f"{message.width}x{message.height} points in {message.header.frame_id}: {names}"


def _some(names: list[str]) -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest


_NOTES: dict[str, Callable[[Any], str]] = {
    "sensor_msgs/msg/Image": lambda m: f"{m.width}x{m.height} {m.encoding}, frame {m.header.frame_id or '?'}",
    "sensor_msgs/msg/CompressedImage": lambda m: f"{m.format}, frame {m.header.frame_id or '?'}",
    "sensor_msgs/msg/CameraInfo": _camera_note,
    _POINT_CLOUD: _cloud_note,
    "sensor_msgs/msg/JointState": lambda m: _some(list(m.name)) or f"{len(m.position)} joints without names",
    "tf2_msgs/msg/TFMessage": _tf_note,
}
