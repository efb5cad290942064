"""Write a log as a LeRobot dataset of version 3 with one episode (LeRobot 0.6, LeRobotDataset)."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from splatbot.atomic import write_text
from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.geometry import inverse, rotation_to_quat, se3_exp, se3_log
from splatbot.logs.base import MILLIMETRES, Log
from splatbot.logs.calibration import Calibration, save_calibration
from splatbot.logs.joints import MAX_GAP
from splatbot.logs.lerobot import POSE, POSE_NAMES, STAMP, STATE
from splatbot.logs.lerobot_camera import INTRINSICS
from splatbot.logs.lerobot_info import EPISODES, INFO
from splatbot.logs.record import Progress
from splatbot.trajectory import Trajectory

COLOR, DEPTH = "observation.images.camera", "observation.images.camera_depth"
_FILE = "chunk-000/file-000.parquet"
_BATCH = 32  # frames in memory, and in a row group
_RATE = 30  # [Hz] of a log with one frame
_TASK = "move the camera"
_TASK_INDEX: dict[str, Any] = {  # by which pandas reads the column `task` as the names of the rows
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
}
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")

_log = logging.getLogger(__name__)


def record_lerobot(log: Log, folder: str | Path, *, progress: Progress | None = None) -> Path:
    """Write colour as PNG and depth as TIFF of float32 [m], which round nothing, with intrinsics, joints and poses.

    Joints are those that the first frame has. Masks and delays of depth are not written. Reference poses are
    interpolated to the stamps of the frames. `timestamp` counts frames at a whole number of frames per second, as
    LeRobot expects; `splatbot.stamp` holds the stamps.

    Args:
        log: frames of one camera.
        folder: folder of the dataset, which must not exist.
        progress: called with the number of frames written so far.

    Returns:
        ``folder``.

    Raises:
        LogError: the folder exists, the camera changes, or a frame of the log cannot be read.
    """
    out = Path(folder)
    if out.exists():
        raise LogError("exists already.", file=out, hint="choose another name")
    first, last = log.read(0), log.read(-1)
    duration = last.stamp - first.stamp
    rows = _Rows(first, log.ground_truth, max(1, round((len(log) - 1) / duration)) if duration > 0 else _RATE)
    (out / "data" / _FILE).parent.mkdir(parents=True)
    with pq.ParquetWriter(
        out / "data" / _FILE, _schema(rows.features), compression="zstd", use_dictionary=False
    ) as file:
        batch: list[dict[str, Any]] = []
        for number, frame in enumerate(log, 1):
            batch.append(rows.row(frame))
            if len(batch) == _BATCH or number == len(log):
                file.write_table(pa.Table.from_pylist(batch, file.schema))
                batch = []
            if progress is not None:
                progress(number)
    save_calibration(Calibration(first.camera, MILLIMETRES, sensor=log.calibration.sensor), out / INTRINSICS)
    _write_description(out, rows)
    for count, lost in ((rows.jointless, "joints"), (rows.masked, "masks"), (rows.delayed, "delays of depth")):
        if count:
            _log.warning("%s: the %s of %d frames are not written", log.uri, lost, count)
    return out


class _Rows:
    """Rows of the frames, and their statistics.

    Args:
        first: the first frame.
        truth: reference poses T_world_camera.
        fps: frames per second.
    """

    def __init__(self, first: Frame, truth: Trajectory | None, fps: int) -> None:
        self._camera, self._truth, self.fps = first.camera, truth, fps
        self._names, self._joints = first.joint_names, 0 if first.joints is None else len(first.joints)
        self.features = _features(first.camera, self._names, self._joints, truth is not None)
        self.moments = {key: _Moments() for key in self.features if key not in (STAMP, POSE)}
        self.moments[COLOR] = _Moments(255.0)
        self.count = self.jointless = self.masked = self.delayed = 0

    def row(self, frame: Frame) -> dict[str, Any]:
        """Return the next row."""
        if frame.camera != self._camera:
            raise LogError("the camera changed.", file=frame.source, field="camera", hint="write two datasets")
        n = self.count
        row: dict[str, Any] = {
            COLOR: {"bytes": _encoded(frame.rgb[..., ::-1], ".png"), "path": f"frame-{n:06d}.png"},
            DEPTH: {"bytes": _encoded(frame.depth, ".tiff"), "path": f"frame-{n:06d}.tiff"},
        }
        row |= {"timestamp": n / self.fps, "frame_index": n, "episode_index": 0, "index": n, "task_index": 0}
        row[STAMP] = frame.stamp
        if STATE in self.features:
            row[STATE] = self._state(frame)
        elif frame.joints is not None:
            self.jointless += 1
        if self._truth is not None:
            row[POSE] = _pose_at(self._truth, frame.stamp)
        self.moments[COLOR].add(np.moveaxis(frame.rgb, -1, 0).reshape(3, -1))
        self.moments[DEPTH].add(frame.depth.reshape(1, -1))
        for key in self.moments.keys() - {COLOR, DEPTH}:
            self.moments[key].add(np.asarray(row[key], np.float64).reshape(-1, 1))
        self.count += 1
        self.masked += frame.mask is not None
        self.delayed += frame.depth_delay != 0
        return row

    def _state(self, frame: Frame) -> list[float]:
        """Return the positions of the joints of the first frame, NaN where one is missing."""
        positions = [] if frame.joints is None else frame.joints.tolist()
        if self._names:
            known = dict(zip(frame.joint_names, positions, strict=False))
            positions = [known.get(name, np.nan) for name in self._names]
        if len(positions) != self._joints or not np.isfinite(positions).all():
            self.jointless += 1
            return [np.nan] * self._joints
        return positions


class _Moments:
    """Statistics of values (K, N) of all frames, divided by a scale.

    Args:
        scale: value that counts as 1.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._scale = scale
        self._frames, self._values = 0, 0
        self._low: Any = np.inf
        self._high: Any = -np.inf
        self._sum: Any = 0.0
        self._squares: Any = 0.0

    def add(self, values: NDArray[Any]) -> None:
        """Add the values (K, N) of a frame, which are left out if one is not finite."""
        if not np.isfinite(values).all():
            return
        self._frames, self._values = self._frames + 1, self._values + values.shape[1]
        self._low, self._high = np.minimum(self._low, values.min(1)), np.maximum(self._high, values.max(1))
        exact = values.astype(np.float64)
        self._sum = self._sum + exact.sum(1)
        self._squares = self._squares + np.einsum("kn,kn->k", exact, exact)

    def result(self, shape: Sequence[int]) -> dict[str, Any]:
        """Return the statistics as lists; those of channels of images are (K, 1, 1)."""
        mean = self._sum / self._values
        deviation = np.sqrt(np.maximum(self._squares / self._values - mean**2, 0))
        found = {"min": self._low, "max": self._high, "mean": mean, "std": deviation}
        as_image = (-1, 1, 1) if len(shape) == 3 else (-1,)
        lists = {name: (np.asarray(value) / self._scale).reshape(as_image).tolist() for name, value in found.items()}
        return lists | {"count": [self._frames]}


def _features(camera: Camera, names: Sequence[str], joints: int, has_poses: bool) -> dict[str, dict[str, Any]]:
    def image(channels: int, **info: Any) -> dict[str, Any]:
        shape = [camera.height, camera.width, channels]
        return {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]} | info

    def column(dtype: str, size: int = 1, names: Sequence[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [size], "names": None if names is None else list(names)}

    return {
        COLOR: image(3),
        DEPTH: image(1, info={"is_depth_map": True, "depth_unit": "m"}),
        **({STATE: column("float32", joints, names or None)} if joints else {}),
        STAMP: column("float64"),
        **({POSE: column("float64", len(POSE_NAMES), POSE_NAMES)} if has_poses else {}),
        "timestamp": column("float32"),
        **{name: column("int64") for name in _COUNTERS},
    }


def _schema(features: dict[str, dict[str, Any]]) -> pa.Schema:
    def kind(feature: dict[str, Any]) -> pa.DataType:
        if feature["dtype"] == "image":
            return _IMAGE
        number = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64()}[feature["dtype"]]
        (size,) = feature["shape"]
        return number if size == 1 else pa.list_(number, size)

    return pa.schema([(key, kind(feature)) for key, feature in features.items()])


def _write_description(out: Path, rows: _Rows) -> None:
    """Write the folder `meta`, last of which is `info.json`, by which a dataset is recognized."""
    stats = {key: moments.result(rows.features[key]["shape"]) for key, moments in rows.moments.items()}
    place = {"chunk_index": 0, "file_index": 0}
    episode = {"episode_index": 0, "tasks": [_TASK], "length": rows.count}
    episode |= {"dataset_from_index": 0, "dataset_to_index": rows.count}
    episode |= {f"{part}/{name}": n for part in ("data", "meta/episodes") for name, n in place.items()}
    episode |= {f"stats/{key}/{name}": value for key, values in stats.items() for name, value in values.items()}
    (out / EPISODES / _FILE).parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist([episode]), out / EPISODES / _FILE)
    tasks = pa.table({"task_index": [0], "task": [_TASK]}).replace_schema_metadata({"pandas": json.dumps(_TASK_INDEX)})
    pq.write_table(tasks, out / "meta/tasks.parquet")
    write_text(json.dumps(stats, indent=4))(out / "meta/stats.json")
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": 1,
        "total_frames": rows.count,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": rows.fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": rows.features,
    }
    write_text(json.dumps(info, indent=4))(out / INFO)


def _pose_at(truth: Trajectory, stamp: float) -> list[float]:
    """Return the pose x, y, z [m], qw, qx, qy, qz at a stamp [s], NaN beyond the poses and in gaps of over 0.1 s."""
    after = int(np.searchsorted(truth.stamps, stamp))
    if after < len(truth) and truth.stamps[after] == stamp:
        T = truth.T_world_camera[after]
    elif 0 < after < len(truth) and truth.stamps[after] - truth.stamps[after - 1] <= MAX_GAP:
        before, T = truth.T_world_camera[after - 1], truth.T_world_camera[after]
        share = (stamp - truth.stamps[after - 1]) / (truth.stamps[after] - truth.stamps[after - 1])
        T = before @ se3_exp(share * se3_log(inverse(before) @ T))
    else:
        return [np.nan] * len(POSE_NAMES)
    return [*T[:3, 3].tolist(), *rotation_to_quat(T[:3, :3]).tolist()]


def _encoded(image: NDArray[Any], suffix: str) -> bytes:
    raw = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE] if suffix == ".tiff" else []
    ok, data = cv2.imencode(suffix, np.ascontiguousarray(image), raw)
    if not ok:
        raise LogError("could not be encoded.", field="image", hint="report this image as a bug")
    return data.tobytes()
