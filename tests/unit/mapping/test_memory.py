"""Memory is bounded and reported by category."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.geometry import inverse, se3_exp
from splatbot.logs import open_log
from splatbot.mapping.culling import without_redundant
from splatbot.mapping.keyframes import Keyframe
from splatbot.slam import Slam
from splatbot.tracking.features import Features
from splatbot.tracking.reference import Reference
from tests.rgbd import CAMERA, Array, small_config, tabletop


def keyframe(number: int, T_world_camera: Array) -> Keyframe:
    reference = Reference(T_world_camera, ())
    return Keyframe(number, CAMERA, torch.zeros(1), torch.zeros(1), T_world_camera, Features.none(), reference)


def test_the_most_redundant_keyframe_goes_first() -> None:
    places = [0.0, 1.0, 2.0, 2.1, 3.0, *np.arange(10.0, 18.0)]
    keyframes = [keyframe(k, se3_exp([x, 0, 0, 0, 0, 0])) for k, x in enumerate(places)]
    assert [k.number for k in without_redundant(keyframes, 12)] == [0, 1, 3, 4, *range(5, 13)]
    assert without_redundant(keyframes, 13) == keyframes


def test_views_in_other_directions_are_not_redundant() -> None:
    turns = [0.0, 0.6, 0.6, 1.2, *np.linspace(2.0, 3.0, 8)]
    keyframes = [keyframe(k, se3_exp([0, 0, 0, 0, turn, 0])) for k, turn in enumerate(turns)]
    assert [k.number for k in without_redundant(keyframes, 11)] == [0, 2, 3, *range(4, 12)]


def test_the_first_and_the_latest_keyframes_stay_however_alike() -> None:
    keyframes = [keyframe(k, np.eye(4)) for k in range(30)]
    kept = [k.number for k in without_redundant(keyframes, 12)]
    assert len(kept) == 12
    assert kept[0] == 0
    assert kept[-8:] == list(range(22, 30))


def test_a_run_with_few_keyframes_tracks_on_and_keeps_no_more() -> None:
    frames, poses = tabletop()
    slam = Slam(small_config(mapping__max_keyframes=10, mapping__keyframe_translation=1e-4))
    for frame in frames:
        assert slam.process(frame).verdict == "ok"
    numbers = [k.number for k in slam.keyframes]
    assert len(numbers) == 10
    assert numbers[-1] == sum(r.keyframe for r in slam.results) - 1 > 9
    last = slam.results[-1].T_world_camera
    assert last is not None
    assert np.linalg.norm((inverse(poses[-1]) @ last)[:3, 3]) < 2e-3


def test_the_reported_bytes_are_those_of_the_arrays() -> None:
    frames, _ = tabletop()
    slam = Slam(small_config())
    for frame in frames[:4]:
        slam.process(frame)
    told = slam.memory
    n = len(slam.snapshot().model)
    assert told["gaussians_bytes"] == slam.snapshot().model.nbytes >= 64 * n
    assert told["optimiser_bytes"] == 4 * n * (1 + 2 * 14)
    assert told["keyframe_images_bytes"] == len(slam.keyframes) * 160 * 120 * (3 + 4)
    assert told["keyframe_tracking_bytes"] > 0


def resident() -> int:
    """Return the bytes of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the resident set is read from Linux's /proc")
def test_the_resident_set_is_flat_over_two_thousand_frames_of_a_loop() -> None:
    log = open_log("synthetic:room?trajectory=laps&frames=2000&width=160&height=120")  # a lap is 600 frames
    slam = Slam(small_config())
    sizes = {}
    for frame in log:
        assert slam.process(frame).verdict != "lost"
        if frame.index >= 700 and frame.index % 100 == 0:
            sizes[frame.index] = resident()
    assert max(sizes.values()) < 1.05 * min(sizes.values()), sizes
