"""Quality of frames as keyframes, and the replacement of poor keyframes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from splatbot.mapping.keyframe_choice import FrameQuality, sharpness_of
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import Observation
from splatbot.tracking.prepare import prepare
from tests.rgbd import small_config, tabletop


def observed(number: int = 0, blur: float = 0.0) -> Observation:
    """Return a frame of the tabletop, with a blurred image if ``blur`` [px] is not 0."""
    frames, poses = tabletop(frames=4)
    frame = frames[number]
    if blur:
        frame = replace(frame, rgb=np.asarray(cv2.GaussianBlur(frame.rgb, (0, 0), blur)))
    return Observation(prepare(frame, small_config().tracking), poses[number])


def test_blur_lowers_the_sharpness_and_an_image_without_grey_has_none() -> None:
    sharp, blurred = (sharpness_of(observed(blur=b).prepared.levels[0].gray) for b in (0.0, 1.5))
    assert 0 < blurred < 0.5 * sharp
    assert sharpness_of(np.full((20, 20), np.nan, np.float32)) == 0.0


def test_a_blurred_and_a_degraded_frame_among_sharp_ones_are_poor() -> None:
    quality, frame = FrameQuality(), observed()
    assert not any(quality.is_poor(frame) for _ in range(5))
    assert quality.is_poor(observed(blur=1.5))
    assert quality.is_poor(replace(frame, verdict="degraded"))
    assert not quality.is_poor(frame)


def test_a_sharp_view_replaces_a_poor_keyframe_of_the_same_place_but_never_the_first_one() -> None:
    mapper = Mapper(small_config(mapping__replace_poor=True))
    poor, sharp = replace(observed(3), is_poor=True), observed(3)
    for observation in (replace(observed(0), is_poor=True), poor):
        mapper.submit(observation)
        while mapper.has_keyframes_to_insert:
            mapper.step()
    assert not mapper.should_insert(poor)
    assert mapper.should_insert(sharp)
    mapper.submit(sharp)
    while mapper.has_keyframes_to_insert:
        mapper.step()
    assert [k.number for k in mapper.keyframes] == [0, 2]
    assert not mapper.should_insert(sharp)
