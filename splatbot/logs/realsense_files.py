"""Files of librealsense's recorder: ROS 1 bags (before 2.58) and rosbag2's SQLite (`.db3`, since then)."""

from __future__ import annotations

import sqlite3
import struct
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from rosbags.highlevel import AnyReader

from splatbot.errors import LogError
from splatbot.geometry import quat_to_rotation
from splatbot.logs.ros_types import Message, typestore
from splatbot.logs.streams import header_stamp
from splatbot.protocols import Array

DEVICE = "/device_0/sensor_"  # beginning of the topics of the first device
MAX_IMAGES = 1_000_000
_MAX_IMAGE_BYTES = 2**27
_MAX_TEXT = 2**14  # bytes
_AGAIN = "record it again, or convert it with rs-convert"
_UNITS = "Depth_Units"


@dataclass(frozen=True)
class Images:
    """Places of the images of a stream, in the order of the recording.

    Args:
        stamps: (N,) of the device [s].
        places: of each image in the file.
    """

    stamps: list[float]
    places: list[Any]


class RealSenseFile(Protocol):
    """A recording of librealsense."""

    def streams(self) -> list[str]:
        """Return the streams, as `/device_0/sensor_0/Depth_0`."""
        ...

    def images(self, stream: str) -> Images:
        """Return the images of a stream; nothing is decoded."""
        ...

    def image(self, stream: str, place: Any) -> Message:
        """Return an image as a sensor_msgs/Image or CompressedImage."""
        ...

    def camera_info(self, stream: str) -> Message:
        """Return the sensor_msgs/CameraInfo of a stream."""
        ...

    def extrinsics(self, stream: str) -> Array:
        """Return the (4, 4) transform of points of the reference stream to those of a stream [m]."""
        ...

    def depth_units(self, stream: str) -> float | None:
        """Return the metres of a unit of depth, or None if they are not recorded."""
        ...


class BagFile:
    """A ROS 1 bag of librealsense.

    Its images have four more bytes than sensor_msgs/Image, so that they are parsed here.

    Raises:
        LogError: the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._reader = AnyReader([path])
            self._reader.open()
        except Exception as error:  # damaged bytes raise any exception in the reader
            raise _damaged(path, error) from error

    def streams(self) -> list[str]:
        """Implement :class:`RealSenseFile`."""
        images = [c for c in self._reader.connections if c.msgtype == "sensor_msgs/msg/Image" and c.msgcount]
        topics = {c.topic for c in images if c.topic.startswith(DEVICE)}
        return sorted(topic.removesuffix("/image/data") for topic in topics)

    def images(self, stream: str) -> Images:
        """Implement :class:`RealSenseFile`."""
        rows = [(header_stamp(raw, ros2=False), at) for at, raw in self._messages(f"{stream}/image/data")]
        return Images([stamp for stamp, _ in rows], [at for _, at in rows])

    def image(self, stream: str, place: Any) -> Message:
        """Implement :class:`RealSenseFile`."""
        for _, raw in self._messages(f"{stream}/image/data", start=place, stop=place + 1):
            return _ros1_image(raw, self.path)
        raise LogError("an image is missing.", file=self.path, field=stream, hint=_AGAIN)

    def camera_info(self, stream: str) -> Message:
        """Implement :class:`RealSenseFile`."""
        return self._first(f"{stream}/info/camera_info")

    def extrinsics(self, stream: str) -> Array:
        """Implement :class:`RealSenseFile`."""
        topics = sorted(c.topic for c in self._reader.connections if c.topic.startswith(f"{stream}/tf/"))
        if not topics:
            raise LogError("has no extrinsics.", file=self.path, field=stream, hint=_AGAIN)
        t, q = (getattr(self._first(topics[0]), name) for name in ("translation", "rotation"))
        T = np.eye(4)
        T[:3, :3] = quat_to_rotation(np.array([q.w, q.x, q.y, q.z]))
        T[:3, 3] = t.x, t.y, t.z
        return T

    def depth_units(self, stream: str) -> float | None:
        """Implement :class:`RealSenseFile`."""
        topic = f"{stream.rpartition('/')[0]}/option/{_UNITS}/value"
        known = any(c.topic == topic for c in self._reader.connections)
        return float(self._first(topic).data) if known else None

    def _first(self, topic: str) -> Message:
        for _, raw in self._messages(topic):
            kind = next(c.msgtype for c in self._reader.connections if c.topic == topic)
            try:
                return self._reader.deserialize(raw, kind)
            except Exception as error:
                raise _damaged(self.path, error) from error
        raise LogError("holds no message.", file=self.path, field=topic, hint=_AGAIN)

    def _messages(self, topic: str, **between: int) -> list[tuple[int, bytes]]:
        """Return the receive times [ns] and the bytes of messages; of images without a range, only their beginnings."""
        wanted = [c for c in self._reader.connections if c.topic == topic]
        keep = 12 if topic.endswith("/image/data") and not between else None
        try:
            return [(at, raw[:keep]) for _, at, raw in self._reader.messages(wanted, **between)] if wanted else []
        except Exception as error:
            raise _damaged(self.path, error) from error


class SqliteFile:
    """A `.db3` file of librealsense, without the metadata.yaml of rosbag2.

    Raises:
        LogError: the file is damaged, or no recording of librealsense.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, check_same_thread=False)
            rows = self._file.execute("SELECT id, name, type FROM topics LIMIT 10000").fetchall()
            self._topics: dict[str, tuple[int, str]] = {
                str(name): (int(number), str(kind)) for number, name, kind in rows
            }
        except (sqlite3.Error, TypeError, ValueError) as error:
            raise _damaged(path, error) from error
        if not any(name.startswith(DEVICE) for name in self._topics):
            hint = "name the folder that holds it and metadata.yaml"
            raise LogError("is one file of a rosbag2 recording.", file=path, field="log", hint=hint)

    def streams(self) -> list[str]:
        """Implement :class:`RealSenseFile`."""
        images = [name for name in self._topics if name.startswith(DEVICE) and "/image/data" in name]
        return sorted(name.partition("/image/data")[0] for name in images)

    def images(self, stream: str) -> Images:
        """Implement :class:`RealSenseFile`; stamps are of the metadata, since headers have the time of recording."""
        rows = self._rows(
            "SELECT id, CAST(timestamp AS INTEGER) FROM messages WHERE topic_id = ? ORDER BY timestamp, id LIMIT ?",
            self._image_topic(stream),
        )
        topic = f"{stream}/image/metadata"
        short = f"topic_id = ? AND length(data) <= {_MAX_TEXT}"
        query = f"SELECT data FROM messages WHERE {short} ORDER BY timestamp, id LIMIT ?"
        texts = [self._string(topic, data) for (data,) in self._rows(query, topic)]
        if len(texts) == len(rows):
            stamps = [self._number(pairs(text), "timestamp", stream) / 1e3 for text in texts]
        else:
            stamps = [(at or 0) / 1e9 for _, at in rows]
        return Images(stamps, [number for number, _ in rows])

    def image(self, stream: str, place: Any) -> Message:
        """Implement :class:`RealSenseFile`."""
        found = self._one("SELECT data FROM messages WHERE id = ? AND length(data) <= ?", place, _MAX_IMAGE_BYTES)
        if found is None:
            raise LogError("an image is missing or too large.", file=self.path, field=stream, hint=_AGAIN)
        return self._deserialize(self._image_topic(stream), found)

    def camera_info(self, stream: str) -> Message:
        """Implement :class:`RealSenseFile`."""
        values = pairs(self._text(f"{stream}/camera_info"))
        width, height, fx, fy, cx, cy = (
            self._number(values, key, stream) for key in ("width", "height", "fx", "fy", "ppx", "ppy")
        )
        lens = [
            self._number({"coeffs": text}, "coeffs", stream) for text in values.get("coeffs", "").split(",") if text
        ]
        model = values.get("model", "")
        K = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        return SimpleNamespace(k=K, d=np.array(lens), distortion_model=model, width=width, height=height)

    def extrinsics(self, stream: str) -> Array:
        """Implement :class:`RealSenseFile`; librealsense's rotations are in the order of columns."""
        topics = sorted(name for name in self._topics if name.startswith(f"{stream}/tf/"))
        if not topics:
            raise LogError("has no extrinsics.", file=self.path, field=stream, hint=_AGAIN)
        values = pairs(self._text(topics[0]))
        try:
            rotation, translation = (
                np.array([float(number) for number in values[key].split(",")]) for key in ("rotation", "translation")
            )
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation.reshape(3, 3).T, translation.reshape(3)
        except (KeyError, ValueError) as error:
            raise LogError("is no transform.", file=self.path, field=topics[0], hint=_AGAIN) from error
        return T

    def depth_units(self, stream: str) -> float | None:
        """Implement :class:`RealSenseFile`."""
        topic = f"{stream.rpartition('/')[0]}/option/{_UNITS}/value"
        return self._number({_UNITS: self._text(topic)}, _UNITS, stream) if topic in self._topics else None

    def _image_topic(self, stream: str) -> str:
        return next(name for name in sorted(self._topics) if name.startswith(f"{stream}/image/data"))

    def _text(self, topic: str) -> str:
        rows = self._rows("SELECT data FROM messages WHERE topic_id = ? ORDER BY id LIMIT min(1, ?)", topic)
        if not rows:
            raise LogError("holds no message.", file=self.path, field=topic, hint=_AGAIN)
        return self._string(topic, rows[0][0])

    def _string(self, topic: str, data: bytes) -> str:
        text = getattr(self._deserialize(topic, data), "data", None)
        if not isinstance(text, str):
            raise LogError("holds no texts.", file=self.path, field=topic, hint=_AGAIN)
        return text

    def _rows(self, query: str, topic: str) -> list[Any]:
        if topic not in self._topics:
            return []
        try:
            return self._file.execute(query, (self._topics[topic][0], MAX_IMAGES)).fetchall()
        except sqlite3.Error as error:
            raise _damaged(self.path, error) from error

    def _one(self, query: str, *values: int) -> bytes | None:
        try:
            row = self._file.execute(query, values).fetchone()
        except sqlite3.Error as error:
            raise _damaged(self.path, error) from error
        return row[0] if row is not None and isinstance(row[0], bytes) else None

    def _deserialize(self, topic: str, data: bytes) -> Message:
        try:
            return typestore().deserialize_cdr(data, self._topics[topic][1])
        except Exception as error:
            raise _damaged(self.path, error) from error

    def _number(self, values: dict[str, str], key: str, stream: str) -> float:
        try:
            number = float(values[key])
        except (KeyError, ValueError) as error:
            raise LogError("is missing or no number.", file=self.path, field=f"{stream} {key}", hint=_AGAIN) from error
        if not np.isfinite(number):
            raise LogError(f"is {number}.", file=self.path, field=f"{stream} {key}", hint=_AGAIN)
        return number


def pairs(text: str) -> dict[str, str]:
    """Return the values of `key=value;key=value;`."""
    return {key: value for key, equals, value in (pair.partition("=") for pair in text.split(";")) if equals}


def _ros1_image(raw: bytes, path: Path) -> Message:
    """Parse a sensor_msgs/Image of ROS 1 with more bytes at its end.

    Raises:
        LogError: it is cut off.
    """
    try:
        (name,) = struct.unpack_from("<I", raw, 12)
        at = 16 + name
        height, width, length = struct.unpack_from("<III", raw, at)
        encoding = raw[at + 12 : at + 12 + length].decode("ascii")
        big, step, size = struct.unpack_from("<BII", raw, at + 12 + length)
    except (struct.error, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error
    begin = at + 12 + length + 9
    if big or len(raw) < begin + size:
        raise LogError("has an image that is cut off.", file=path, field="image", hint=_AGAIN)
    data = np.frombuffer(raw, np.uint8, size, begin)
    return SimpleNamespace(encoding=encoding, height=height, width=width, step=step, data=data, is_bigendian=0)


def _damaged(path: Path, error: Exception) -> LogError:
    return LogError(f"cannot be read ({type(error).__name__}: {error}).", file=path, field="log", hint=_AGAIN)
