"""The end of the frames: exhausted, or by a signal during the wait for the next one."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator

import pytest

from splatbot.config import load_config
from splatbot.logs import open_log
from splatbot.run.interrupts import Interrupts
from splatbot.run.loop import FrameLoop
from splatbot.run.pacing import Arrival, LogFrames
from splatbot.slam import Slam

CONFIG = load_config(overrides={"mapping.refine_iterations": 1, "mapping.final_iterations": 1})


class SignalledFrames(LogFrames):
    """Two frames; signals arrive during the wait for a third one, which never comes."""

    def __init__(self, camera: bool, *numbers: int) -> None:
        super().__init__(open_log("synthetic:tabletop?frames=2&width=80&height=60"), total=2)
        self._camera, self._numbers = camera, numbers

    @property
    def live(self) -> bool:
        return self._camera

    def __iter__(self) -> Generator[Arrival, None, None]:
        yield from super().__iter__()
        for number in self._numbers:
            os.kill(os.getpid(), number)


@pytest.mark.parametrize(
    ("camera", "numbers", "cut"),
    [
        (True, [], None),
        (True, [signal.SIGINT], None),  # Ctrl-C is the normal end of a camera
        (True, [signal.SIGINT, signal.SIGINT], "mapping"),
        (True, [signal.SIGTERM], "mapping"),
        (False, [], None),
        (False, [signal.SIGINT], "refinement"),  # all frames of the log are mapped
    ],
)
def test_a_signal_during_the_wait_for_a_frame_ends_a_camera_as_one_during_a_frame_does(
    camera: bool, numbers: list[int], cut: str | None
) -> None:
    with Interrupts() as interrupts:
        loop = FrameLoop(SignalledFrames(camera, *numbers), Slam(CONFIG), CONFIG, "stop", lambda _: None)
        loop.run(interrupts)
    assert loop.crash is None
    assert len(loop.rows()) == 2
    assert loop.cut == cut
    assert (interrupts.requested is None) == (cut is None)
