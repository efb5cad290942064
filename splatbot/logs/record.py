"""Write frames as a TUM log that `open_log` reads back."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.base import Log, LogBase
from splatbot.logs.calibration import Calibration, save_calibration
from splatbot.logs.joints import NAME as JOINTS
from splatbot.logs.joints import joint_header
from splatbot.trajectory import Trajectory

Progress = Callable[[int], None]

_log = logging.getLogger(__name__)


def record(
    frames: Log | Iterable[Frame],
    folder: str | Path,
    *,
    ground_truth: Trajectory | None = None,
    depth_scale: float = 5000.0,
    sensor: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write colour as PNG, depth as 16-bit PNG, stamps, intrinsics, poses and, if available, joints at both times.

    A frame is listed only when both of its images are on the disk. An interrupted recording is therefore a shorter but
    valid log.

    Args:
        frames: frames of one camera.
        folder: folder of the log; it is created and must not contain a recording.
        ground_truth: reference poses T_world_camera. If None, those of ``frames`` are used if it is a log with a
            reference.
        depth_scale: units per metre; depth beyond 65535 units is written as missing, and logged.
        sensor: values of the section `sensor` of the configuration. If None, those of ``frames`` are used if it is a
            log.
        progress: called with the number of frames written so far.

    Returns:
        ``folder``.

    Raises:
        LogError: the folder holds a recording already, or the camera changes.
    """
    out = Path(folder)
    if (out / "rgb.txt").exists():
        raise LogError("holds a recording already.", file=out, field="rgb.txt", hint="choose another folder")
    truth = ground_truth if ground_truth is not None else getattr(frames, "ground_truth", None)
    if sensor is None:
        sensor = frames.calibration.sensor if isinstance(frames, LogBase) else {}
    for part in ("rgb", "depth"):
        (out / part).mkdir(parents=True, exist_ok=True)
    if truth is not None:
        truth.save(out / "groundtruth.txt")
    camera = None
    (out / "depth.txt").unlink(missing_ok=True)  # of a recording that was cut off before its first colour image
    with _LineFile(out / "depth.txt") as depths, _LineFile(out / "rgb.txt") as colors, _JointLines(out) as joints:
        for number, frame in enumerate(frames):
            if camera is None:
                camera = frame.camera
                save_calibration(Calibration(camera, depth_scale, sensor=sensor), out / "intrinsics.json")
            elif frame.camera != camera:
                raise LogError("the camera changed.", file=frame.source, field="camera", hint="record two logs")
            name = f"{number:06d}.png"
            joints.add(frame)
            _write_png(out / "rgb" / name, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
            _write_png(out / "depth" / name, _to_units(frame, depth_scale))
            # Depth first: a depth image without colour is harmless, but colour without depth is an error.
            for lines, part, delay in ((depths, "depth", frame.depth_delay), (colors, "rgb", 0.0)):
                lines.append(f"{float(frame.stamp + delay)!r} {part}/{name}")
            if progress is not None:
                progress(number + 1)
    return out


class _JointLines(AbstractContextManager["_JointLines"]):
    """The file `joints.txt`: positions at the times of colour and of depth, in the order of time.

    Its columns are the joints of the first frame with any. A frame that lacks one of them gets no line.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOINTS
        self._columns: tuple[tuple[str, ...], int] | None = None  # names and number
        self._waiting: list[tuple[float, NDArray[np.float64]]] = []  # stamp [s] and positions of further lines
        self._last = -np.inf  # [s] stamp of the last line

    def add(self, frame: Frame) -> None:
        """Write the positions of a frame; those at the time of a later depth image wait for the next frame."""
        if frame.joints is None:
            return
        if self._columns is None:
            self._columns = frame.joint_names, len(frame.joints)
            _check_names(frame)
        names, count = self._columns
        missing = ", ".join(sorted(set(names) - set(frame.joint_names)))
        if missing or (not names and (frame.joint_names or len(frame.joints) != count)):
            reason = f"no {missing}" if missing else "others"
            _log.warning("frame %d is recorded without joints: %s", frame.index, reason)
            return
        order = [frame.joint_names.index(name) for name in names] if names else list(range(count))
        self._waiting.append((frame.stamp, frame.joints[order]))
        if frame.depth_joints is not None and np.isfinite(frame.depth_joints[order]).all():
            self._waiting.append((frame.stamp + frame.depth_delay, frame.depth_joints[order]))
        self._write(frame.stamp)

    def _write(self, until: float) -> None:
        """Write the waiting lines up to a time [s] that are later than the last one."""
        due = sorted((line for line in self._waiting if line[0] <= until), key=lambda line: line[0])
        self._waiting = [line for line in self._waiting if line[0] > until]
        for stamp, positions in due:
            if stamp <= self._last:
                continue
            with _LineFile(self._path) as lines:
                if self._columns is not None and self._columns[0] and np.isinf(self._last):
                    lines.append(joint_header(self._columns[0]))
                lines.append(" ".join(map(repr, (float(stamp), *positions.tolist()))))
            self._last = stamp

    def __exit__(self, *_: object) -> None:
        self._write(np.inf)


def _check_names(frame: Frame) -> None:
    for name in frame.joint_names:
        if not name or name.split() != [name]:
            hint = "joints.txt separates names by spaces; record an .mcap file"
            raise LogError(f"has a joint {name!r}.", file=frame.source, field="joint_names", hint=hint)


class _LineFile:
    """A text file that only ever holds whole lines, also after an error of the disk."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("ab", buffering=0)

    def append(self, line: str) -> None:
        """Append a line.

        Raises:
            OSError: the disk is full or not available; the file ends with the line before.
        """
        data, size = f"{line}\n".encode(), os.fstat(self._file.fileno()).st_size
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self._file.truncate(size)
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def __enter__(self) -> _LineFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _to_units(frame: Frame, depth_scale: float) -> NDArray[np.uint16]:
    units = np.rint(frame.depth.astype(np.float64) * depth_scale)
    far = units > np.iinfo(np.uint16).max
    if far.any():
        limit = np.iinfo(np.uint16).max / depth_scale
        _log.warning("%s: %d pixels beyond %.1f m written as missing", frame.source or frame.index, far.sum(), limit)
    return np.where(far, 0, units).astype(np.uint16)


def _write_png(path: Path, image: NDArray[Any]) -> None:
    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise LogError("could not be encoded.", file=path, field="image", hint="report this image as a bug")
    path.write_bytes(data.tobytes())
