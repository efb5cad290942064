"""Conversion of frames to ROS messages and back: images, intrinsics, joints, poses. Messages use quaternions xyzw."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.errors import CameraError, InputError
from splatbot.frame import Frame
from splatbot.geometry import pose_from_quat, rotation_to_quat
from splatbot.logs.image_size import image_size
from splatbot.logs.ros_types import Message, build
from splatbot.logs.undistort import check_lens

COLOR_ENCODINGS = ("rgb8", "bgr8", "rgba8", "bgra8")
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
_RADIAL = ("plumb_bob", "rational_polynomial")  # OpenCV's 4 to 14 coefficients
_FISHEYES = ("equidistant", "fisheye")  # OpenCV's cv2.fisheye: Kannala-Brandt
_MILLIMETRES = 1000.0  # of 16UC1 and mono16 (REP 118)
_COMPRESSED_DEPTH_HEADER = 12  # bytes before the PNG: format and two quantisation parameters, used by 32FC1 alone
_NANO = 10**9


@dataclass(frozen=True, eq=False)
class RosFrame(Frame):
    """A frame of a ROS camera.

    Args:
        camera_frame: name of the optical frame of the camera in TF.
    """

    camera_frame: str = field(default="", kw_only=True)


def to_nanoseconds(stamp: float) -> int:
    """Return a time [s] in nanoseconds; of Unix times, the product with 1e9 would be off by up to 128 ns."""
    seconds = math.floor(stamp)
    return seconds * _NANO + round((stamp - seconds) * _NANO)


def time_of(seconds: float) -> Message:
    """Convert a stamp [s] to builtin_interfaces/Time, rounded to nanoseconds."""
    sec, nanosec = divmod(to_nanoseconds(float(seconds)), _NANO)
    return build("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def seconds_of(time: Message) -> float:
    """Convert a builtin_interfaces/Time or Duration to the nearest float [s]."""
    return (int(time.sec) * _NANO + int(time.nanosec)) / _NANO


def header(stamp: float, frame_id: str) -> Message:
    """Build a std_msgs/Header for a stamp [s]."""
    return build("std_msgs/msg/Header", stamp=time_of(stamp), frame_id=frame_id)


def image_message(stamp: float, image: NDArray[Any], frame_id: str = "camera") -> Message:
    """Build a sensor_msgs/Image of colour (H, W, 3) uint8, depth (H, W) float32 [m] or a mask (H, W) bool.

    They become rgb8, 32FC1 and mono8 (255 where true).
    """
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * 255
    encoding = {(np.dtype("uint8"), 3): "rgb8", (np.dtype("float32"), 2): "32FC1", (np.dtype("uint8"), 2): "mono8"}
    return build(
        "sensor_msgs/msg/Image",
        header=header(stamp, frame_id),
        height=image.shape[0],
        width=image.shape[1],
        encoding=encoding[image.dtype, image.ndim],
        step=image.shape[1] * image.itemsize * (3 if image.ndim == 3 else 1),
        data=np.ascontiguousarray(image).reshape(-1).view(np.uint8),
    )


def color_of(message: Message) -> NDArray[np.uint8]:
    """Decode the RGB image (H, W, 3) of a sensor_msgs/Image or CompressedImage.

    Raises:
        InputError: it is of another encoding, cut short or damaged.
    """
    if hasattr(message, "format"):
        return np.ascontiguousarray(_decode(message, message.data, cv2.IMREAD_COLOR)[..., ::-1])
    if message.encoding not in COLOR_ENCODINGS:
        raise _encoding(message, COLOR_ENCODINGS)
    pixels = _pixels(message, np.dtype(np.uint8), len(message.encoding) - 1)[..., :3]
    return np.array(pixels if message.encoding.startswith("rgb") else pixels[..., ::-1], order="C")


def size_of(message: Message) -> tuple[int, int]:
    """Return width and height of a sensor_msgs/Image or CompressedImage; nothing is decoded.

    Raises:
        InputError: the compressed image is neither PNG nor JPEG.
    """
    if not hasattr(message, "format"):
        return int(message.width), int(message.height)
    data = np.asarray(message.data, np.uint8)
    size = image_size((data[_COMPRESSED_DEPTH_HEADER:] if "compressedDepth" in message.format else data).tobytes())
    if size is None:
        raise InputError("is neither PNG nor JPEG.", field="data", hint="compress images as PNG or JPEG")
    return size


def depth_of(message: Message) -> NDArray[np.float32]:
    """Decode depth (H, W) [m], 0 where missing, of a sensor_msgs/Image or CompressedImage; 16 bits are millimetres.

    Raises:
        InputError: it is of another encoding, cut short or damaged.
    """
    if hasattr(message, "format"):
        return _compressed_depth(message)
    if message.encoding not in DEPTH_ENCODINGS:
        raise _encoding(message, DEPTH_ENCODINGS)
    dtype = np.dtype(np.float32 if message.encoding == "32FC1" else np.uint16)
    depth = _pixels(message, dtype, 1)[..., 0]
    return _metres(depth)


def mask_of(message: Message) -> NDArray[np.bool_]:
    """Decode a mask (H, W), True where a mono8 image is not black.

    Raises:
        InputError: it is of another encoding or cut short.
    """
    if message.encoding not in ("mono8", "8UC1"):
        raise _encoding(message, ("mono8", "8UC1"))
    return np.asarray(_pixels(message, np.dtype(np.uint8), 1)[..., 0] > 0)


def camera_info_message(stamp: float, camera: Camera, frame_id: str = "camera") -> Message:
    """Build a sensor_msgs/CameraInfo of an undistorted camera."""
    k = camera.K
    return build(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([k, np.zeros((3, 1))]).ravel(),
    )


def camera_of(message: Message) -> Camera:
    """Convert a sensor_msgs/CameraInfo of ROS 1 or 2 to a camera with its distortion.

    Coefficients that are all 0 are no distortion. A fisheye (`equidistant` or `fisheye`) needs others, because drivers
    write them for rectified images as well as for an ideal equidistant lens.

    Raises:
        CameraError: a value makes no sense, or the distortion is of another model. A lens sees 180 degrees or more.
    """
    k, d = (np.asarray(getattr(message, a, getattr(message, a.upper(), None)), np.float64) for a in ("k", "d"))
    if not k.any():
        raise CameraError("is all 0.", field="K", hint="calibrate the camera, or give --camera FILE")
    model = message.distortion_model or "plumb_bob"
    fisheye = model in _FISHEYES
    if fisheye and not d.any():
        hint = "name plumb_bob if the images are rectified; give --camera FILE with fisheye: true for an ideal lens"
        raise CameraError(f"has no coefficients other than 0 of {model!r}.", field="D", hint=hint)
    if model not in (*_FISHEYES, *_RADIAL) and d.any():
        hint = f"undistort the images, or use {', '.join((*_RADIAL, *_FISHEYES))}"
        raise CameraError(f"is {model!r:.40}.", field="distortion_model", hint=hint)
    try:
        distortion = tuple(d.tolist()) if d.any() else ()
        fx, fy, cx, cy = k[[0, 4, 2, 5]].tolist()
        camera = Camera(fx, fy, cx, cy, int(message.width), int(message.height), distortion, fisheye)
        camera.check_plausible()
        check_lens(camera)
    except CameraError as error:
        if error.field != "distortion":
            raise
        raise CameraError(f"{error.message.rstrip('.')} ({model}).", field="D", hint=error.hint) from error
    return camera


def joint_state_message(stamp: float, positions: ArrayLike, names: tuple[str, ...] = ()) -> Message:
    """Build a sensor_msgs/JointState of positions (J,) [rad or m]; unnamed joints are joint1, joint2, ..."""
    q = np.asarray(positions, np.float64)
    names = names or tuple(f"joint{i + 1}" for i in range(len(q)))
    return build("sensor_msgs/msg/JointState", header=header(stamp, ""), name=list(names), position=q)


def pose_message(T: ArrayLike) -> Message:
    """Convert a transform (4, 4) to geometry_msgs/Pose."""
    M = np.asarray(T, np.float64)
    w, *xyz = rotation_to_quat(M[:3, :3]).tolist()
    named = dict(zip("xyz", xyz, strict=True))
    return build("geometry_msgs/msg/Pose", position=_xyz(M[:3, 3]), orientation=named | {"w": w})


def pose_stamped_message(stamp: float, T: ArrayLike, frame_id: str) -> Message:
    """Convert a transform (4, 4) into ``frame_id`` to geometry_msgs/PoseStamped."""
    return build("geometry_msgs/msg/PoseStamped", header=header(stamp, frame_id), pose=pose_message(T))


def pose_of(message: Message) -> NDArray[np.float64]:
    """Convert a geometry_msgs/Pose or Transform to a transform (4, 4).

    Raises:
        InputError: the quaternion is zero or a value is not finite.
    """
    at = getattr(message, "position", None) or message.translation
    q = getattr(message, "orientation", None) or message.rotation
    try:
        T = pose_from_quat((at.x, at.y, at.z), (q.w, q.x, q.y, q.z))
    except ValueError as error:
        raise InputError(f"{error}.", field="orientation", hint="use w = 1 for no rotation") from error
    if not np.isfinite(T).all():
        raise InputError("is not finite.", field="position", hint="give metres")
    return T


def _xyz(values: ArrayLike) -> dict[str, float]:
    return dict(zip("xyz", np.asarray(values, np.float64).tolist(), strict=True))


def _pixels(message: Message, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """Return the pixels (H, W, channels) of an Image with any row padding and byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    step = step or row
    if height <= 0 or width <= 0 or step < row or data.size < step * (height - 1) + row:
        raise InputError(
            f"has {data.size} bytes of data for {width}x{height} {message.encoding} and a step of {step}.",
            field="data",
            hint="send height * step bytes",
        )
    rows = np.lib.stride_tricks.as_strided(np.ascontiguousarray(data), (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype.newbyteorder("<"))
    if message.is_bigendian and dtype.itemsize > 1:
        pixels = pixels.byteswap()
    return np.asarray(pixels, dtype).reshape(height, width, channels)


def _metres(depth: NDArray[Any]) -> NDArray[np.float32]:
    if depth.dtype == np.uint16:
        return depth.astype(np.float32) / np.float32(_MILLIMETRES)
    return np.nan_to_num(depth.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _compressed_depth(message: Message) -> NDArray[np.float32]:
    data = np.asarray(message.data, np.uint8)
    if "compressedDepth" in message.format:
        if message.format.startswith("32FC1"):
            raise InputError("is quantised 32FC1.", field="format", hint="record 16UC1, or raw images")
        data = data[_COMPRESSED_DEPTH_HEADER:]
    image = _decode(message, data, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise InputError(f"is {image.dtype} {image.shape}.", field="data", hint="compress depth as 16-bit PNG")
    return _metres(image)


def _decode(message: Message, data: NDArray[np.uint8], flags: int) -> NDArray[Any]:
    try:
        image = cv2.imdecode(np.ascontiguousarray(data), flags)
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"is no {message.format} image that can be decoded.", field="data", hint="send it again")
    return image


def _encoding(message: Message, known: tuple[str, ...]) -> InputError:
    return InputError(f"is {message.encoding!r}.", field="encoding", hint=f"send {', '.join(known)}")
