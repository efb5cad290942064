"""Damaged logs: each message names file, field and fix, and the frames before the damage stay readable."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.errors import CameraError, InputError, LogError
from splatbot.logs import open_log

MakeLog = Callable[..., Path]
BAD = 2  # the frame that is damaged


def frames_before_error(folder: Path, **options: Any) -> tuple[int, LogError]:
    """Count the frames that iteration yields before it raises, and return the error."""
    count = 0
    try:
        for frame in open_log(folder, **options):
            assert frame.index == count
            count += 1
    except LogError as error:
        return count, error
    pytest.fail("the whole log was read without an error")


def assert_complete(error: InputError, file: Path, field: str) -> None:
    assert error.file == str(file)
    assert error.field == field
    assert error.hint
    assert error.exit_code == 2
    assert str(file) in str(error)
    assert "Fix: " in str(error)


def assert_only_frame_is_bad(folder: Path, file: Path, field: str) -> LogError:
    """Assert that frames before BAD are yielded, BAD raises, and the next frame can still be read."""
    count, error = frames_before_error(folder)
    assert count == BAD
    assert_complete(error, file, field)
    assert open_log(folder).read(BAD + 1).index == BAD + 1
    return error


@pytest.mark.parametrize("part", ["rgb", "depth"])
@pytest.mark.parametrize("keep", [0.0, 0.002, 0.5, 0.99])
def test_a_truncated_png(make_log: MakeLog, part: str, keep: float) -> None:
    folder = make_log()
    path = folder / part / f"{BAD:06d}.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    assert_only_frame_is_bad(folder, path, "colour" if part == "rgb" else "depth")


def test_a_truncated_jpeg(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / "rgb" / f"{BAD:06d}.jpg"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8))
    (folder / "rgb.txt").write_text((folder / "rgb.txt").read_text().replace(f"{BAD:06d}.png", f"{BAD:06d}.jpg"))
    assert len(list(open_log(folder))) == 5
    path.write_bytes(path.read_bytes()[:-200])
    error = assert_only_frame_is_bad(folder, path, "colour")
    assert "truncated JPEG" in error.message


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_flipped_byte_in_a_png(make_log: MakeLog, part: str) -> None:
    folder = make_log()
    path = folder / part / f"{BAD:06d}.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    error = assert_only_frame_is_bad(folder, path, "colour" if part == "rgb" else "depth")
    assert "corrupt PNG" in error.message


def test_a_file_that_is_no_image(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / "rgb" / f"{BAD:06d}.png"
    path.write_bytes(b"<html>not found</html>")
    assert_only_frame_is_bad(folder, path, "colour")


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_missing_image(make_log: MakeLog, part: str) -> None:
    folder = make_log()
    path = folder / part / f"{BAD:06d}.png"
    path.unlink()
    error = assert_only_frame_is_bad(folder, path, "colour" if part == "rgb" else "depth")
    assert "No such file" in error.message


def test_a_missing_line_of_depth_txt(make_log: MakeLog, drop_line: Callable[[Path, int], str]) -> None:
    folder = make_log()
    assert "000002" in drop_line(folder / "depth.txt", 2 + BAD)  # line 1 is the heading
    error = assert_only_frame_is_bad(folder, folder / "depth.txt", "after line 3")
    assert "rgb/000002.png" in error.message
    assert "0.066667" in error.message


def test_a_missing_first_line_of_depth_txt(make_log: MakeLog, drop_line: Callable[[Path, int], str]) -> None:
    folder = make_log()
    drop_line(folder / "depth.txt", 2)
    count, error = frames_before_error(folder)
    assert count == 0
    assert_complete(error, folder / "depth.txt", "first line")
    assert len([open_log(folder).read(i) for i in range(1, 5)]) == 4


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
@pytest.mark.parametrize("line", ["0.0666", "zero rgb/000002.png", "nan rgb/000002.png", "\x00\x01\x02"])
def test_a_malformed_line_is_named_on_opening(make_log: MakeLog, name: str, line: str) -> None:
    folder = make_log()
    lines = (folder / name).read_text().splitlines()
    lines[3] = line
    (folder / name).write_text("\n".join(lines))
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert_complete(caught.value, folder / name, "line 4")


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_stamps_out_of_order_are_named_on_opening(make_log: MakeLog, name: str) -> None:
    folder = make_log()
    lines = (folder / name).read_text().splitlines()
    lines[3], lines[4] = lines[4], lines[3]
    (folder / name).write_text("\n".join(lines))
    with pytest.raises(LogError, match="not after") as caught:
        open_log(folder)
    assert_complete(caught.value, folder / name, "line 5")


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
@pytest.mark.parametrize("content", ["", "# only a heading\n\n"])
def test_an_empty_log(make_log: MakeLog, name: str, content: str) -> None:
    folder = make_log()
    (folder / name).write_text(content)
    with pytest.raises(LogError, match=r"empty.*Fix: ") as caught:
        open_log(folder)
    assert caught.value.file == str(folder / name)


def test_a_missing_list(make_log: MakeLog) -> None:
    folder = make_log()
    (folder / "depth.txt").unlink()
    with pytest.raises(LogError, match=r"depth\.txt.*No such file.*Fix: "):
        open_log(folder)


def test_two_clocks(make_log: MakeLog) -> None:
    folder = make_log()
    text = (folder / "depth.txt").read_text().replace("\n0.", "\n1700000000.")
    (folder / "depth.txt").write_text(text)
    with pytest.raises(LogError) as caught:
        open_log(folder)
    assert_complete(caught.value, folder / "depth.txt", "stamps")


def test_no_intrinsics(make_log: MakeLog) -> None:
    folder = make_log()
    (folder / "intrinsics.json").unlink()
    with pytest.raises(CameraError) as caught:
        open_log(folder)
    assert_complete(caught.value, folder / "intrinsics.json", "camera")
    assert "tum_fr1|tum_fr2|tum_fr3" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"fx": None}, "fx"),
        ({"fy": "wide"}, "fy"),
        ({"fx": -500.0}, "fx"),
        ({"width": 0}, "width"),
        ({"depth_scale": 0}, "depth_scale"),
        ({"depth_scale": None}, "depth_scale"),
        ({"distortion": [0.1, 0.2]}, "distortion"),
        ({"distortion": 0.1}, "distortion"),
    ],
)
def test_wrong_intrinsics(make_log: MakeLog, change: dict[str, Any], field: str) -> None:
    folder = make_log()
    path = folder / "intrinsics.json"
    values = json.loads(path.read_text()) | change
    path.write_text(json.dumps({key: value for key, value in values.items() if value is not None}))
    with pytest.raises(CameraError) as caught:
        open_log(folder)
    assert_complete(caught.value, path, field)


@pytest.mark.parametrize("content", ["{", "[1, 2]", "\xff"])
def test_intrinsics_that_are_no_json_object(make_log: MakeLog, content: str) -> None:
    folder = make_log()
    (folder / "intrinsics.json").write_text(content, encoding="latin-1")
    with pytest.raises(CameraError, match="JSON") as caught:
        open_log(folder)
    assert caught.value.file == str(folder / "intrinsics.json")


def test_an_unknown_camera_lists_the_presets(make_log: MakeLog) -> None:
    with pytest.raises(CameraError, match="tum_fr1, tum_fr2, tum_fr3") as caught:
        open_log(make_log(), camera="tum_fr9")
    assert caught.value.field == "camera"


def test_intrinsics_of_another_image_size(make_log: MakeLog) -> None:
    folder = make_log()
    values = json.loads((folder / "intrinsics.json").read_text()) | {"width": 640, "height": 480}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    count, error = frames_before_error(folder)
    assert count == 0
    assert_complete(error, folder / "rgb/000000.png", "image size")
    assert "640x480" in error.message
    assert "intrinsics.json" in error.message


def test_colour_of_another_size_than_depth(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / f"depth/{BAD:06d}.png"
    cv2.imwrite(str(path), np.full((24, 32), 5000, np.uint16))
    error = assert_only_frame_is_bad(folder, path, "depth size")
    assert "32x24" in error.message
    assert "64x48" in error.message


def test_all_zero_depth(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / f"depth/{BAD:06d}.png"
    cv2.imwrite(str(path), np.zeros((48, 64), np.uint16))
    assert "no valid depth" in assert_only_frame_is_bad(folder, path, "depth").message


def test_all_nan_depth(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / f"depth/{BAD:06d}.tiff"
    cv2.imwrite(str(path), np.full((48, 64), np.nan, np.float32))
    text = (folder / "depth.txt").read_text().replace(f"{BAD:06d}.png", path.name)
    (folder / "depth.txt").write_text(text)
    assert "no valid depth" in assert_only_frame_is_bad(folder, path, "depth").message


def test_negative_depth(make_log: MakeLog) -> None:
    folder = make_log()
    path = folder / f"depth/{BAD:06d}.tiff"
    cv2.imwrite(str(path), np.full((48, 64), -1.0, np.float32))
    text = (folder / "depth.txt").read_text().replace(f"{BAD:06d}.png", path.name)
    (folder / "depth.txt").write_text(text)
    assert "negative" in assert_only_frame_is_bad(folder, path, "depth").message


@pytest.mark.parametrize(
    ("image", "problem"),
    [(np.full((48, 64), 100, np.uint8), "uint8"), (np.full((48, 64, 3), 100, np.uint8), "3 channel")],
)
def test_depth_of_the_wrong_pixel_type(make_log: MakeLog, image: np.ndarray, problem: str) -> None:
    folder = make_log()
    path = folder / f"depth/{BAD:06d}.png"
    cv2.imwrite(str(path), image)
    error = assert_only_frame_is_bad(folder, path, "depth")
    assert problem in error.message
    assert "16-bit PNG" in (error.hint or "")


@pytest.mark.parametrize(("wrong", "units", "likely"), [(1.0, 1200, "1000"), (10_000_000.0, 5500, "5000")])
def test_a_wrong_depth_scale_is_named_with_a_likely_value(
    make_log: MakeLog, wrong: float, units: int, likely: str
) -> None:
    folder = make_log()
    values = json.loads((folder / "intrinsics.json").read_text()) | {"depth_scale": wrong}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    cv2.imwrite(str(folder / "depth/000000.png"), np.full((48, 64), units, np.uint16))
    count, error = frames_before_error(folder)
    assert count == 0
    assert_complete(error, folder / "intrinsics.json", "depth_scale")
    assert f"; {likely} would" in (error.hint or "")


def test_a_damaged_groundtruth_leaves_the_frames_readable(make_log: MakeLog) -> None:
    folder = make_log()
    (folder / "groundtruth.txt").write_text("0.0 1 2 3\n")
    log = open_log(folder)
    assert len(list(log)) == 5
    with pytest.raises(InputError) as caught:
        _ = log.ground_truth
    assert_complete(caught.value, folder / "groundtruth.txt", "line 1")
