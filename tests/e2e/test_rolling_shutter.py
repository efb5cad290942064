"""A camera whose rolling shutter and exposure are modelled is tracked; without the model it is not."""

from __future__ import annotations

from typing import Any

import pytest

from splatbot.config import load_config
from splatbot.evaluation import absolute_error
from splatbot.logs import open_log
from splatbot.slam import Slam

FAST_MAPPING = {"mapping.refine_iterations": 2, "mapping.final_iterations": 1}
ROOM = "synthetic:room?trajectory=turns&frames=45"  # 120 °/s


def ate_mm(effects: str, sensor: dict[str, Any], every: int = 1) -> float:
    """Return the ATE [mm] of frames of the room, and check that all are tracked."""
    slam, log = Slam(load_config(overrides=FAST_MAPPING | sensor)), open_log(f"{ROOM}&effects={effects}")
    indices = range(0, len(log), every)
    for index in indices:
        slam.process(log[index])
    assert len(slam.trajectory) == len(indices)
    assert log.ground_truth is not None
    return 1e3 * absolute_error(log.ground_truth, slam.trajectory).rmse


@pytest.mark.long
def test_a_rolling_shutter_of_30_ms_at_120_degrees_a_second_costs_4_mm_with_its_model_and_15_without() -> None:
    effects = "rolling_shutter:readout=0.03"
    assert ate_mm(effects, {"sensor.readout": 0.03}) < 4
    assert ate_mm(effects, {}) > 15


@pytest.mark.long
def test_the_velocity_of_a_tenth_of_a_second_ago_is_no_guide_and_the_rows_measure_it() -> None:
    """The camera turns back within three frames. Two rectifications a frame left 81 mm."""
    assert ate_mm("rolling_shutter:readout=0.03", {"sensor.readout": 0.03}, every=3) < 8
