"""Offsets of depth from colour, of images that were shifted by a known number of pixels."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.evaluation import depth_offset
from splatbot.frame import Frame

SIZE = (240, 320)
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, SIZE[1], SIZE[0])


def frame(shift: tuple[int, int] = (0, 0), *, objects: int = 12, textured: bool = True, steps: bool = True) -> Frame:
    """Return objects of one grey before a darker wall, 1 and 2 m away; depth is shifted by ``shift`` (u, v)."""
    rng = np.random.default_rng(0)
    gray = np.full(SIZE, 60, np.uint8)
    depth = np.full(SIZE, 2.0, np.float32)
    for _ in range(objects):
        v, u, size = rng.integers(20, 190), rng.integers(20, 270), rng.integers(15, 40)
        patch = np.s_[v : v + size, u : u + size]
        gray[patch] = rng.integers(90, 220) if textured else 60
        depth[patch] = 1.0 if steps else 2.0
    depth = np.roll(depth, shift[::-1], (0, 1))
    return Frame(0.0, np.repeat(gray[..., None], 3, 2), depth, CAMERA)


@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (-5, 4), (0, 6)])
def test_a_shift_of_depth_is_found_and_taken_back_by_the_answer(shift: tuple[int, int]) -> None:
    u, v = depth_offset([frame(shift)] * 2) or (99, 99)
    # The near side of an edge is a pixel inside the object: the grey gradient is equally large on both sides of it.
    assert abs(u + shift[0]) <= 1
    assert abs(v + shift[1]) <= 1


def test_frames_that_tell_too_little_each_tell_it_together() -> None:
    sparse = frame((4, 0), objects=2)
    assert depth_offset([sparse] * 2) is None
    u, v = depth_offset([sparse] * 6) or (99, 99)
    assert abs(u + 4) <= 1
    assert abs(v) <= 1


def test_without_steps_in_depth_nothing_is_said() -> None:
    assert depth_offset([frame(steps=False)] * 2) is None


def test_without_edges_in_colour_nothing_is_said() -> None:
    assert depth_offset([frame(textured=False)] * 2) is None


def test_a_pattern_that_repeats_has_no_clear_offset() -> None:
    columns = np.arange(SIZE[1]) // 2 % 2
    gray = np.broadcast_to((60 + 120 * columns).astype(np.uint8), SIZE)
    striped = Frame(0.0, np.repeat(gray[..., None], 3, 2), frame().depth, CAMERA)
    assert depth_offset([striped] * 2) is None


def test_what_a_mask_leaves_out_has_no_edges() -> None:
    whole = frame((3, 0))
    masked = Frame(0.0, whole.rgb, whole.depth, CAMERA, mask=np.zeros(SIZE, bool))
    assert depth_offset([masked] * 2) is None


def test_frames_that_contradict_each_other_say_nothing() -> None:
    assert depth_offset([frame((4, 0)), frame((4, 0))]) is not None
    assert depth_offset([frame((4, 0)), frame((-2, 0))]) is None


def test_no_frames_and_one_that_no_other_confirms_say_nothing() -> None:
    assert depth_offset([]) is None
    assert depth_offset([frame()]) is None


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (4, 5), (5, 400), (400, 5)])
def test_frames_too_small_to_search_say_nothing(size: tuple[int, int]) -> None:
    camera = Camera(300.0, 300.0, size[1] / 2, size[0] / 2, size[1], size[0])
    small = Frame(0.0, np.zeros((*size, 3), np.uint8), np.ones(size, np.float32), camera)
    assert depth_offset([small] * 2) is None
