"""Writer of LeRobot datasets by the layout of lerobot 0.6.1, independent of the reader and the writer under test."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.video.stream import VideoStream
from numpy.typing import NDArray

from splatbot.frame import Frame
from tests.unit.logs.published import encoded, intrinsics, units, write

FPS = 30
WRIST = "observation.images.wrist"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
CODES = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}

Episodes = Sequence[Sequence[Frame]]


def video_path(key: str) -> str:
    """Return the path of a video in a dataset."""
    return f"videos/{key}/chunk-000/file-000.mp4"


def tiff(image: NDArray[Any]) -> bytes:
    """Return the TIFF of one uncompressed strip of uint16 or float32 (TIFF 6.0)."""
    height, width = image.shape
    data = image.tobytes()
    kind = {"u": 1, "f": 3}[image.dtype.kind]  # SampleFormat
    tags = [(256, width), (257, height), (258, 8 * image.itemsize), (259, 1), (262, 1), (273, 0), (277, 1)]
    tags += [(278, height), (279, len(data)), (339, kind)]
    at = 8 + 2 + 12 * len(tags) + 4
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, at if tag == 273 else value) for tag, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + struct.pack("<I", 0) + data


def depth_codes(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """Return depth [m] as 12-bit codes (BEHAVIOR-1K, obs_utils), as LeRobot's default writes them."""
    low, high = math.log(0.01 + 3.5), math.log(10.0 + 3.5)
    share = (np.log(depth.astype(np.float64) + 3.5) - low) / (high - low)
    return np.rint(4095 * share).clip(0, 4095).astype(np.uint16)


def write_video(path: Path, images: Sequence[NDArray[Any]], kind: str, codec: str, **options: str) -> None:
    """Write an MP4; ``kind`` is the pixel format of the images (rgb24 or gray12le)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = cast(VideoStream, file.add_stream(codec, FPS, options=options))
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p" if kind == "rgb24" else kind
        for image in images:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=kind)))
        file.mux(stream.encode())


def write_lerobot(
    folder: Path,
    cameras: dict[str, Episodes],
    *,
    video: bool = False,
    unit: str = "mm",
    columns: dict[str, tuple[dict[str, Any], Sequence[Any]]] | None = None,
    group: int | None = None,
) -> Path:
    """Write episodes of cameras, all of equal lengths, and `intrinsics.json`.

    Args:
        folder: of the dataset.
        cameras: episodes of colour and depth by the key of colour; depth has the key with `_depth`.
        video: write colour as AV1 and depth as lossless HEVC, instead of images.
        unit: of depth images: "mm" is uint16, "m" float32.
        columns: further features by key: description, and one value a frame.
        group: rows in a group of the table, by default all.
    """
    lengths = [len(episode) for episode in next(iter(cameras.values()))]
    total = sum(lengths)
    features: dict[str, Any] = {}
    table: dict[str, Any] = {}
    for key, episodes in cameras.items():
        frames = [frame for episode in episodes for frame in episode]
        c = frames[0].camera
        for name, channels in ((key, 3), (f"{key}_depth", 1)):
            shape = {"shape": [c.height, c.width, channels], "names": ["height", "width", "channels"]}
            features[name] = {"dtype": "video" if video else "image", **shape}
        features[f"{key}_depth"]["info"] = {"is_depth_map": True, "depth_unit": unit}
        if video:
            features[f"{key}_depth"]["info"] |= {f"video.{name}": value for name, value in CODES.items()}
            write_video(folder / video_path(key), [f.rgb for f in frames], "rgb24", "libsvtav1", crf="10", g="2")
            codes = [depth_codes(f.depth) for f in frames]
            hevc = {"g": "2", "x265-params": "lossless=1:log-level=none"}
            write_video(folder / video_path(f"{key}_depth"), codes, "gray12le", "libx265", **hevc)
        else:
            depths = [units(f) if unit == "mm" else f.depth for f in frames]
            names = [f"frame-{n:06d}" for n in range(total)]
            table[key] = [{"bytes": encoded(f.rgb), "path": f"{n}.png"} for n, f in zip(names, frames, strict=True)]
            table[f"{key}_depth"] = [
                {"bytes": tiff(d), "path": f"{n}.tiff"} for n, d in zip(names, depths, strict=True)
            ]
        write(folder / "intrinsics.json", json.dumps(intrinsics(frames[0])))
    for name, (feature, values) in (columns or {}).items():
        features[name], table[name] = feature, list(values)
    count = [n for length in lengths for n in range(length)]
    table["timestamp"] = pa.array(np.array(count, np.float32) / np.float32(FPS))
    table["frame_index"] = count
    table["episode_index"] = [e for e, length in enumerate(lengths) for _ in range(length)]
    table["index"], table["task_index"] = list(range(total)), [0] * total
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    write_table(folder / DATA, pa.table(table), group)
    keys = [name for key in cameras for name in (key, f"{key}_depth")] if video else []
    write_table(folder / EPISODES, pa.Table.from_pylist(episode_rows(lengths, keys)))
    info = {"codebase_version": "v3.0", "fps": FPS, "total_episodes": len(lengths), "total_frames": total}
    info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    write(folder / "meta/info.json", json.dumps(info | {"features": features}, indent=4))
    return folder


def episode_rows(lengths: Sequence[int], videos: Sequence[str]) -> list[dict[str, Any]]:
    """Return the rows of `meta/episodes`; all videos of a key are in one file."""
    rows, start = [], 0
    for number, length in enumerate(lengths):
        row: dict[str, Any] = {"episode_index": number, "tasks": ["look"], "length": length}
        row |= {"data/chunk_index": 0, "data/file_index": 0}
        row |= {"dataset_from_index": start, "dataset_to_index": start + length}
        for key in videos:
            row |= {f"videos/{key}/chunk_index": 0, f"videos/{key}/file_index": 0}
            span = {"from_timestamp": start / FPS, "to_timestamp": (start + length) / FPS}
            row |= {f"videos/{key}/{name}": value for name, value in span.items()}
        rows.append(row)
        start += length
    return rows


def write_table(path: Path, table: pa.Table, group: int | None = None) -> None:
    """Write a parquet file and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, row_group_size=group, compression="snappy")


def edit_table(path: Path, **changes: Callable[[list[Any]], Any] | None) -> None:
    """Replace columns by functions of their values, or remove them; `__` in a name is a slash."""
    table = pq.read_table(path)
    for name, change in changes.items():
        column = name.replace("__", "/")
        index = table.schema.get_field_index(column)
        values = table.column(index).to_pylist()
        table = table.remove_column(index)
        if change is not None:
            table = table.append_column(column, pa.array(change(values)))
    write_table(path, table)


def edit_info(folder: Path, **changes: Any) -> None:
    """Replace values of `meta/info.json`, or remove them where they are None."""
    path = folder / "meta/info.json"
    values = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in values.items() if value is not None}))


def edit_feature(folder: Path, key: str, **changes: Any) -> None:
    """Replace values of a feature."""
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    features[key] |= changes
    edit_info(folder, features=features)
