"""Frame: accepted, repaired and refused inputs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


def make(**change: Any) -> Frame:
    values: dict[str, Any] = {
        "rgb": np.zeros((48, 64, 3), np.uint8),
        "depth": np.ones((48, 64), np.float32),
        "camera": CAMERA,
    }
    return Frame(stamp=0.0, source="here.png", **(values | change))


def test_nan_and_infinity_are_missing_and_the_input_is_not_written_to() -> None:
    depth = np.ones((48, 64), np.float32)
    depth[0, :3] = [np.nan, np.inf, -np.inf]
    frame = make(depth=depth)
    assert frame.depth[0, :3].tolist() == [0, 0, 0]
    assert frame.valid.sum() == 48 * 64 - 3
    assert np.isnan(depth[0, 0])


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"rgb": np.zeros((48, 64, 3), np.float32)}, "rgb"),
        ({"rgb": np.zeros((48, 64), np.uint8)}, "rgb"),
        ({"rgb": np.zeros((48, 64, 4), np.uint8)}, "rgb"),
        ({"depth": np.ones((48, 64))}, "depth"),
        ({"depth": np.ones((48, 64), np.uint16)}, "depth"),
        ({"depth": np.ones((48, 64, 1), np.float32)}, "depth"),
        ({"depth": np.ones((24, 32), np.float32)}, "depth size"),
        ({"depth": np.full((48, 64), -1, np.float32)}, "depth"),
        ({"camera": CAMERA.resized(128, 96)}, "image size"),
    ],
)
def test_images_that_do_not_fit_are_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        make(**change)
    assert (caught.value.file, caught.value.field) == ("here.png", field)
    assert caught.value.hint


def test_without_a_source_the_index_names_the_frame() -> None:
    with pytest.raises(InputError, match="frame 7"):
        Frame(0.0, np.zeros((2, 2), np.uint8), np.ones((2, 2), np.float32), CAMERA, 7)
