"""Frames and poses that the tests of log formats write."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.frame import Frame
from splatbot.logs import open_log
from tests.unit.logs.published import Pose, units


@pytest.fixture(scope="session")
def scene() -> tuple[list[Frame], list[Pose]]:
    """Six frames of the synthetic tabletop, depth in whole millimetres, and their exact poses T_world_camera."""
    log = open_log("synthetic:tabletop?frames=6&width=160&height=120")
    truth = log.ground_truth
    assert truth is not None
    frames = [Frame(f.stamp, f.rgb, units(f).astype(np.float32) / np.float32(1000), f.camera, f.index) for f in log]
    return frames, list(truth.T_world_camera)
