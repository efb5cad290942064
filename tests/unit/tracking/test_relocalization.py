"""Relocalization: the camera is found among all keyframes, and two frames have to agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from splatbot.tracking.relocalization import RelocalizationCandidate
from tests.unit.tracking.test_tracker import Run


def blacked(frame: Frame) -> Frame:
    """Return a frame without light and without depth."""
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth=np.zeros_like(frame.depth))


def lost_run(**overrides: object) -> Run:
    """Create a run with keyframes along the path that is lost at its far end."""
    run = Run(width=320, **overrides)
    for i in (4, 8, 11):
        run.keyframes.append(run.keyframe(run.prepare(run.frames[i]), run.poses[i]))
    run.tracker.motion.update(run.frames[11].stamp, run.poses[11] @ se3_exp([0.4, 0.1, 0, 0, 0.4, 0]))
    assert run.track(blacked(run.frames[11])).verdict == "lost"
    return run


def test_a_moved_camera_is_found_among_all_keyframes_and_confirmed_by_the_second_frame() -> None:
    run = lost_run()
    first = run.track(replace(run.frames[1], stamp=2.0))
    assert first.verdict == "lost"
    assert first.reasons == ("found again, the next frame must confirm it",)
    second = run.track(replace(run.frames[2], stamp=2.0 + 1 / 30))
    assert second.verdict == "ok"
    assert run.error(second, 2)[0] < 2e-3


def test_two_frames_that_contradict_each_other_are_not_accepted() -> None:
    """The camera is found at one end of the path, and 1 ms later at the other end, 0.3 m away."""
    run = lost_run()
    assert run.track(replace(run.frames[1], stamp=2.0)).verdict == "lost"
    jumped = run.track(replace(run.frames[11], stamp=2.001))
    assert jumped.verdict == "lost"
    again = run.track(replace(run.frames[10], stamp=2.001 + 1 / 30))
    assert again.verdict == "ok"
    assert run.error(again, 10)[0] < 2e-3


def test_a_frame_after_forgetting_is_not_confirmed_by_one_before_and_is_searched_from_the_latest_keyframe() -> None:
    run = lost_run()
    run.track(replace(run.frames[1], stamp=2.0))
    assert run.tracker.awaits_confirmation
    run.tracker.forget()
    assert not run.tracker.awaits_confirmation
    assert run.tracker._search.next_index(3) == 2
    run.tracker._search.restart()
    assert run.track(replace(run.frames[2], stamp=2.0 + 1 / 30)).verdict == "lost"


@pytest.mark.parametrize(("moved", "dt", "agrees"), [(0.05, 1 / 30, True), (0.3, 1 / 30, False), (0.3, 0.5, True)])
def test_a_camera_moves_at_the_speed_of_an_arm_or_a_hand(moved: float, dt: float, agrees: bool) -> None:
    candidate = RelocalizationCandidate(1.0, np.eye(4))
    assert candidate.agrees(1.0 + dt, se3_exp([moved, 0, 0, 0, 0, 0])) is agrees
