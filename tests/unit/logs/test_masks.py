"""Masks of a TUM folder: one for all frames or one for each, and clear messages for invalid masks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs import open_log

MakeLog = Callable[..., Path]


def write_mask(path: Path, blacked: Any, shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    mask = np.full(shape, 255, np.uint8)
    mask[blacked] = 0
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), mask)
    return mask > 0


def test_a_log_without_masks_uses_every_pixel(make_log: MakeLog) -> None:
    assert open_log(make_log(1))[0].mask is None


def test_one_mask_serves_all_frames(make_log: MakeLog) -> None:
    folder = make_log(2)
    mask = write_mask(folder / "mask.png", np.s_[30:])
    for frame in open_log(folder):
        assert frame.mask is not None
        assert np.array_equal(frame.mask, mask)
        assert not frame.valid[30:].any()


def test_each_frame_takes_the_mask_of_its_time(make_log: MakeLog) -> None:
    folder = make_log(3)
    masks = [write_mask(folder / f"mask/{i}.png", np.s_[10 * i : 10 * i + 10]) for i in range(3)]
    lines = [f"{i / 30 + 0.004:.6f} mask/{i}.png" for i in range(3)]
    (folder / "mask.txt").write_text("\n".join(lines))
    for frame, mask in zip(open_log(folder), masks, strict=True):
        assert frame.mask is not None
        assert np.array_equal(frame.mask, mask)


def test_a_frame_without_its_mask_is_an_error_not_an_unmasked_frame(make_log: MakeLog) -> None:
    folder = make_log(2)
    write_mask(folder / "mask/0.png", np.s_[:5])
    (folder / "mask.txt").write_text("0.0 mask/0.png\n")
    log = open_log(folder)
    assert log[0].mask is not None
    with pytest.raises(LogError, match=r"mask\.txt: stamps: no mask within 0\.02 s of stamp 0\.033333.*Fix: list"):
        log[1]


def test_masks_of_another_size_or_in_colour_are_refused_by_name(make_log: MakeLog) -> None:
    folder = make_log(1)
    write_mask(folder / "mask.png", np.s_[:5], (24, 32))
    with pytest.raises(LogError, match="mask size: the mask is 32x24, the image 64x48"):
        open_log(folder)[0]
    cv2.imwrite(str(folder / "mask.png"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(LogError, match=r"mask\.png: mask: has 3 channel"):
        open_log(folder)


def test_masks_of_a_distorted_camera_are_undistorted_with_the_image(make_log: MakeLog) -> None:
    folder = make_log(1)
    calibration = json.loads((folder / "intrinsics.json").read_text())
    calibration["distortion"] = [0.2, -0.1, 0.0, 0.0, 0.0]
    (folder / "intrinsics.json").write_text(json.dumps(calibration))
    mask = write_mask(folder / "mask.png", np.s_[:, :20])
    frame = open_log(folder)[0]
    assert frame.mask is not None
    assert not frame.mask[24, :18].any()
    assert frame.mask[24, 24:40].all()
    assert not np.array_equal(frame.mask, mask)
