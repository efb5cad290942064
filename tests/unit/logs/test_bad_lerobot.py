"""Damaged LeRobot datasets: each message names file, field and fix, and the other frames stay readable."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from tests.unit.logs.published import Pose, encoded

pytest.importorskip("av", reason="av (extra lerobot) is not installed")
pytest.importorskip("pyarrow", reason="pyarrow (extra lerobot) is not installed")

import pyarrow as pa
import pyarrow.parquet as pq

from splatbot.logs.lerobot_tables import read_columns
from tests.unit.logs.lerobot_dataset import (
    DATA,
    EPISODES,
    WRIST,
    edit_feature,
    edit_info,
    edit_table,
    tiff,
    write_lerobot,
)

Scene = tuple[list[Frame], list[Pose]]
DEPTH = f"{WRIST}_depth"
HUGE = 2**31 - 1
Edit = Callable[[list[Any]], Any]


@pytest.fixture
def images(tmp_path: Path, scene: Scene) -> Path:
    """A dataset of images with two episodes of three frames."""
    return write_lerobot(tmp_path / "images", {WRIST: [scene[0][:3], scene[0][3:]]})


def refused(folder: Path, file: str, field: str, message: str = "Fix: ") -> None:
    """Assert that a log is refused when it is opened."""
    with pytest.raises(InputError, match=message) as error:
        open_log(folder)
    assert error.value.file == str(folder / file)
    assert error.value.field == field
    assert error.value.hint


def only_frame_is_bad(folder: Path, bad: int, message: str) -> None:
    """Assert that one frame of three is damaged, and the others are readable before and after it."""
    log = open_log(folder)
    for k in (2, 1, 0, 1, 2):
        if k != bad:
            assert log[k].index == k
            continue
        with pytest.raises(LogError, match=message) as error:
            log[k]
        assert error.value.hint
        assert f"frame {bad}" in str(error.value)


@pytest.mark.parametrize(
    "template",
    [
        "../chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "data/../../file.parquet",
        "/etc/file-{file_index:03d}.parquet",
        "data/{chunk_index:099999999999d}.parquet",
        "data/{chunk_index.__class__}.parquet",
        "data/{secret}.parquet",
        "data/\0.parquet",
        "",
        7,
        None,
    ],
)
def test_templates_of_paths_stay_in_the_folder(images: Path, template: Any) -> None:
    edit_info(images, data_path=template)
    refused(images, "meta/info.json", "data_path", "template of paths")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"fps": 0}, "fps"),
        ({"fps": None}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"fps": 10**400}, "fps"),
        ({"fps": True}, "fps"),
        ({"fps": "30"}, "fps"),
        ({"codebase_version": 3}, "codebase_version"),
        ({"codebase_version": "v4.0"}, "codebase_version"),
        ({"features": []}, "features"),
        ({"features": {"a": 1}}, "features"),
        ({"features": {}}, "features"),
    ],
)
def test_wrong_values_of_the_description_are_named(images: Path, changes: dict[str, Any], field: str) -> None:
    edit_info(images, **changes)
    refused(images, "meta/info.json", field)


@pytest.mark.parametrize(
    "text", ['{"codebase_version": ', '["codebase_version"]', '"codebase_version"' + "[" * 200_000]
)
def test_a_description_that_is_no_object_is_refused(images: Path, text: str) -> None:
    (images / "meta/info.json").write_text(text + ' "codebase_version"')
    with pytest.raises(LogError, match="Fix: "):
        open_log(images)


def test_an_unknown_or_wrong_unit_is_named(images: Path) -> None:
    edit_feature(images, DEPTH, info={"is_depth_map": True, "depth_unit": "inch"})
    refused(images, "meta/info.json", f"features.{DEPTH}.info.depth_unit", 'write "m" or "mm"')
    edit_feature(images, DEPTH, info={"is_depth_map": True, "depth_unit": "m"})
    with pytest.raises(LogError, match=r"depth_unit: makes the first depth image implausible\. Fix: "):
        open_log(images)[0]


@pytest.mark.parametrize(("file", "field"), [(DATA, "file"), (EPISODES, "file")])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.95])
def test_truncated_tables_are_refused(images: Path, file: str, field: str, keep: float) -> None:
    data = (images / file).read_bytes()
    (images / file).write_bytes(data[: int(keep * len(data))])
    refused(images, file, field, "is no whole parquet file")


def test_missing_chunks_are_named(images: Path) -> None:
    (images / DATA).unlink()
    refused(images, DATA, "file", "does not exist")
    (images / EPISODES).unlink()
    refused(images, "meta/episodes", "files", "holds no episodes")


@pytest.mark.parametrize(
    ("column", "edit", "message"),
    [
        ("timestamp", lambda v: [0.0, float("nan"), 0.1] * 2, "not increasing"),
        ("timestamp", lambda v: [0.0, 0.2, 0.1] * 2, "not increasing"),
        ("timestamp", lambda v: [0.0, 0.0, 0.1] * 2, "not increasing"),
        ("timestamp", lambda v: [0.0, 0.1, 1e30] * 2, "not increasing"),
        ("timestamp", lambda v: ["0"] * 6, "is of type string"),
        ("timestamp", None, "no such column"),
        ("frame_index", lambda v: [0, 2, 1, 0, 1, 2], "does not count the 3 frames"),
        ("frame_index", lambda v: [0, 0, 1, 0, 1, 2], "does not count the 3 frames"),
        ("frame_index", lambda v: [float(x) for x in v], "is of type double"),
        ("frame_index", lambda v: [0, None, 2, 0, 1, 2], "empty cells"),
        ("index", lambda v: [x + 1 for x in v], "does not count the 3 frames"),
        (WRIST, lambda v: [1] * 6, "is of type int64"),
        (DEPTH, None, "no such column"),
    ],
)
def test_wrong_columns_are_refused_on_opening(images: Path, column: str, edit: Edit | None, message: str) -> None:
    edit_table(images / DATA, **{column: edit})
    refused(images, DATA, column, message)


def test_rows_of_an_episode_must_be_as_many_as_its_length(images: Path) -> None:
    edit_table(images / DATA, episode_index=lambda v: [0, 0, 1, 1, 1, 1])
    refused(images, DATA, "frame_index", "does not count the 3 frames")


def test_lengths_of_equal_episodes_may_be_huge(images: Path) -> None:
    edit_table(images / EPISODES, length=lambda v: [2**40, 3], dataset_to_index=lambda v: [2**40, 6])
    refused(images, "meta/episodes", "length of episode 0")


def test_tables_of_more_values_than_memory_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pq.write_table(pa.table({"a": np.zeros(100_000)}), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 10_000
    monkeypatch.setattr("splatbot.logs.lerobot_tables._MAX_BYTES", 2**16)
    with pytest.raises(LogError, match=r"rows: has over 65536 bytes of numbers\. Fix: "):
        read_columns(tmp_path / "a.parquet", numbers=["a"])


def test_a_damaged_description_of_columns_does_not_end_the_process(images: Path) -> None:
    data = (images / EPISODES).read_bytes()
    for at in range(1, 1500, 3):  # the footer lies at the end
        damaged = bytearray(data)
        damaged[-at] ^= 0x15
        (images / EPISODES).write_bytes(damaged)
        with suppress(LogError):
            open_log(images)


@pytest.mark.parametrize("option", ["episode=x", "episode=-1", "episode=99999999999", "episodes=1", "episode=2"])
def test_wrong_options_are_named(images: Path, option: str) -> None:
    with pytest.raises(LogError, match="episode"):
        open_log(f"{images}?{option}")


def widened(data: bytes) -> bytes:
    """Return a TIFF of 160 columns whose header announces more than memory holds."""
    old, new = (struct.pack("<HHII", 256, 4, 1, width) for width in (160, HUGE))
    return data.replace(old, new)


def with_image(folder: Path, key: str, data: bytes | None, row: int = 1) -> None:
    """Replace the image of a row."""

    def change(values: list[Any]) -> list[Any]:
        return [{"bytes": data, "path": "a"} if n == row else value for n, value in enumerate(values)]

    table = pq.read_table(folder / DATA)
    index = table.schema.get_field_index(key)
    kind = table.schema.field(index).type
    values = change(table.column(index).to_pylist())
    pq.write_table(table.set_column(index, key, pa.array(values, kind)), folder / DATA)


@pytest.mark.parametrize(
    ("key", "data", "message"),
    [
        (WRIST, b"", "is no PNG, JPEG or TIFF"),
        (WRIST, None, "is not embedded"),
        (WRIST, encoded(np.zeros((8, 8, 3), np.uint8)), "is 8x8; the intrinsics are for 160x120"),
        (WRIST, b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", HUGE, HUGE), f"is {HUGE}x{HUGE}"),
        (WRIST, encoded(np.zeros((120, 160, 3), np.uint8))[:-30], "truncated PNG"),
        (DEPTH, tiff(np.zeros((8, 8), np.uint16)), "is 8x8"),
        (DEPTH, widened(tiff(np.ones((120, 160), np.float32))), f"is {HUGE}x120"),
        (DEPTH, tiff(np.ones((120, 160), np.uint16))[:300], "can be decoded"),
        (DEPTH, tiff(np.zeros((120, 160), np.uint16)), "no valid depth"),
        (DEPTH, b"II*\0\xff\xff\xff\xff", "is no PNG, JPEG or TIFF"),
        (DEPTH, encoded(np.zeros((120, 160, 3), np.uint8)), r"has 3 channel\(s\) of uint8"),
        (DEPTH, encoded(np.zeros((120, 160), np.uint8)), r"has 1 channel\(s\) of uint8"),
        (DEPTH, tiff(np.full((120, 160), -1000, np.float32)), "negative"),
    ],
)
def test_a_damaged_image_is_an_error_of_its_frame(images: Path, key: str, data: bytes | None, message: str) -> None:
    with_image(images, key, data)
    only_frame_is_bad(images, 1, message)


def test_depth_may_be_a_png_and_nan_is_missing(images: Path, scene: Scene) -> None:
    with_image(images, DEPTH, encoded(np.full((120, 160), 1500, np.uint16)))
    assert (open_log(images)[1].depth == 1.5).all()
    edit_feature(images, DEPTH, info={"is_depth_map": True})
    depth = scene[0][1].depth.copy()
    depth[:60] = np.nan
    with_image(images, DEPTH, tiff(depth))
    np.testing.assert_array_equal(open_log(images)[1].depth, np.nan_to_num(depth))


def test_images_of_another_size_than_the_intrinsics_are_refused(images: Path) -> None:
    values = json.loads((images / "intrinsics.json").read_text())
    (images / "intrinsics.json").write_text(json.dumps(values | {"width": 320}))
    with pytest.raises(LogError, match="is 160x120; the intrinsics are for 320x120"):
        open_log(images)[0]


def test_rows_of_poses_and_joints_need_one_length(tmp_path: Path, scene: Scene) -> None:
    feature = {"dtype": "float64", "shape": [7]}
    for name, values, message in (
        ("splatbot.camera_pose", [[0.0] * 6] * 6, "has 6 values"),
        ("splatbot.camera_pose", [[0.0] * (6 + k % 2) for k in range(6)], "different lengths"),
        ("observation.state", ["a"] * 6, "is of type string"),
        ("observation.state", [[], [], [], [], [], []], "Fix: "),
        ("splatbot.stamp", [float("inf")] * 6, "not increasing"),
    ):
        folder = write_lerobot(tmp_path, {WRIST: [scene[0]]}, columns={name: (feature, values)})
        refused(folder, DATA, name, message)
