"""Damaged videos of LeRobot datasets: a damaged image is an error of its frame, and no file is followed elsewhere."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import Log, open_log
from tests.unit.logs.published import Pose

pytest.importorskip("av", reason="av (extra lerobot) is not installed")
pytest.importorskip("pyarrow", reason="pyarrow (extra lerobot) is not installed")

import av

from tests.unit.logs.lerobot_dataset import (
    EPISODES,
    WRIST,
    depth_codes,
    edit_feature,
    edit_info,
    edit_table,
    video_path,
    write_lerobot,
    write_video,
)
from tests.unit.logs.test_bad_lerobot import only_frame_is_bad, refused

Scene = tuple[list[Frame], list[Pose]]
DEPTH = f"{WRIST}_depth"


@pytest.fixture
def videos(tmp_path: Path, scene: Scene) -> Path:
    """A dataset of videos with two episodes of three frames."""
    return write_lerobot(tmp_path / "videos", {WRIST: [scene[0][:3], scene[0][3:]]}, video=True)


def readable(log: Log, frames: Sequence[Frame], order: Sequence[int]) -> set[int]:
    """Return the frames that can be read in an order; these have the right content."""
    good: set[int] = set()
    for k in order:
        try:
            frame = log[k]
        except LogError:
            continue
        np.testing.assert_allclose(frame.depth, frames[k].depth, atol=2e-3)
        assert np.abs(frame.rgb.astype(int) - frames[k].rgb).mean() < 6
        good.add(k)
    return good


def test_keys_of_videos_stay_in_the_folder(videos: Path) -> None:
    edit_info(videos, video_path="{video_key}/../../{chunk_index}.mp4")
    refused(videos, "meta/info.json", "video_path", "template of paths")


@pytest.mark.parametrize(
    "changes",
    [
        {"video.depth_min": -1.0},
        {"video.depth_min": 20.0},
        {"video.depth_max": float("inf")},
        {"video.depth_max": 1e300},
        {"video.depth_max": "ten"},
        {"video.shift": -5.0},
        {"video.shift": 10**400},
        {"video.depth_min": [1]},
    ],
)
def test_a_quantization_without_sense_is_refused(videos: Path, changes: dict[str, Any]) -> None:
    edit_feature(videos, DEPTH, info={"is_depth_map": True} | changes)
    refused(videos, "meta/info.json", f"features.{DEPTH}.info")


@pytest.mark.parametrize(
    ("column", "values", "field", "message"),
    [
        ("dataset_from_index", [0, 2], "dataset_from_index", "shared by 2 episodes"),
        ("dataset_to_index", [2**40, 6], "length of episode 0", "is 3 for frames 0 to 1099511627776"),
        ("length", [2**62, 3], "length of episode 0", "is 4611686018427387904"),
        ("length", [0, 3], "length of episode 0", "is 0 for frames 0 to 3"),
        ("episode_index", [0, 0], "episode_index", "has 2 rows of episode 0"),
        ("episode_index", [7, 8], "episode_index", r"has 0 rows of episode 0\. Fix: its 2 episodes are 7, 8"),
        (f"videos/{WRIST}/from_timestamp", [0.0, 0.05], f"videos/{WRIST}/from_timestamp", "shared by 2 episodes"),
        (f"videos/{WRIST}/from_timestamp", [float("nan"), 0.1], f"videos/{WRIST}/from_timestamp", "is nan to"),
        (f"videos/{WRIST}/from_timestamp", [-5.0, 0.1], f"videos/{WRIST}/from_timestamp", "is -5 to"),
    ],
)
def test_wrong_or_overlapping_episodes_are_refused(
    videos: Path, column: str, values: list[Any], field: str, message: str
) -> None:
    edit_table(videos / EPISODES, **{column: lambda _: values})
    refused(videos, "meta/episodes", field, message)


def test_a_truncated_video_keeps_the_frames_before(tmp_path: Path, scene: Scene) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]}, video=True)
    path = folder / video_path(DEPTH)
    data = path.with_suffix(".copy.mp4")
    with av.open(str(path)) as source, av.open(str(data), "w", options={"movflags": "faststart"}) as copy:
        stream = copy.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                copy.mux(packet)
    path.write_bytes(data.read_bytes()[: int(0.5 * data.stat().st_size)])
    log = open_log(folder)
    good = readable(log, scene[0], [5, 0, 1, 2, 3, 4])
    assert 0 in good
    assert 5 not in good
    assert readable(log, scene[0], [4, 3, 2, 1, 0, 5]) == good


@pytest.mark.parametrize(("key", "codec", "kind"), [(WRIST, "libsvtav1", "rgb24"), (DEPTH, "libx265", "gray12le")])
def test_a_damaged_image_of_a_video_is_an_error_of_its_frame(
    tmp_path: Path, scene: Scene, key: str, codec: str, kind: str
) -> None:
    folder = write_lerobot(tmp_path, {WRIST: [scene[0]]}, video=True)
    path, images = folder / video_path(key), [f.rgb if key == WRIST else depth_codes(f.depth) for f in scene[0]]
    options = {"crf": "10"} if key == WRIST else {"x265-params": "lossless=1:keyint=1:log-level=none"}
    write_video(path, images, kind, codec, g="1", **options)
    with av.open(str(path)) as file:
        places = {
            round(packet.pts / 512): (packet.pos, packet.size)
            for packet in file.demux(video=0)
            if packet.pts is not None and packet.pos is not None
        }
    data, (at, size) = bytearray(path.read_bytes()), places[3]
    data[at : at + size] = b"\xff" * size
    path.write_bytes(data)
    assert readable(open_log(folder), scene[0], [3, 0, 1, 2, 3, 4, 5, 4, 3, 2]) == {0, 1, 2, 4, 5}


@pytest.mark.parametrize(
    "data", [b"", b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n", b"ffconcat version 1.0\nfile /etc/passwd\n"]
)
def test_a_file_that_is_no_video_is_not_followed(videos: Path, data: bytes) -> None:
    (videos / video_path(WRIST)).write_bytes(data)
    refused(videos, video_path(WRIST), "video", "is no whole MP4 video")


def test_a_video_that_ends_early_is_an_error_of_the_late_frames(videos: Path, scene: Scene) -> None:
    write_video(videos / video_path(WRIST), [f.rgb for f in scene[0][:2]], "rgb24", "libx264", g="1")
    only_frame_is_bad(videos, 2, "beyond the end of the video")


def test_depth_of_8_bits_is_refused(videos: Path, scene: Scene) -> None:
    write_video(videos / video_path(DEPTH), [f.rgb for f in scene[0]], "rgb24", "libx264")
    with pytest.raises(LogError, match="is a video of 8 bits; depth has 12"):
        open_log(videos)[0]


def test_missing_videos_are_named(videos: Path) -> None:
    (videos / video_path(DEPTH)).unlink()
    refused(videos, video_path(DEPTH), "video", "does not exist")


def test_videos_of_another_size_than_the_intrinsics_are_refused(videos: Path) -> None:
    values = json.loads((videos / "intrinsics.json").read_text())
    (videos / "intrinsics.json").write_text(json.dumps(values | {"width": 320}))
    refused(videos, video_path(WRIST), "image size", "is 160x120; the intrinsics are for 320x120")
