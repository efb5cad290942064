"""The real recordings with the default configuration: every frame tracked, within what their references support."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from splatbot.logs import open_log
from splatbot.run import map_log

# name, frames, ATE RMSE [m]; the references are good to a few mm, 5 to 29 mm, 8 to 15 mm and about 3 cm.
LOGS = [
    pytest.param("arm_wrist_48", 48, 0.004, id="arm_wrist_48"),
    pytest.param("apc_shelf_robot", 15, 0.025, id="apc_shelf_robot"),
    pytest.param("visp_tabletop", 99, 0.020, id="visp_tabletop", marks=pytest.mark.long),
    pytest.param("redkitchen_000_199", 200, 0.015, id="redkitchen_000_199", marks=pytest.mark.long),
]


@pytest.mark.parametrize(("name", "frames", "ate_m"), LOGS)
def test_every_frame_is_tracked_within_the_bound(
    data_root: Path, tmp_path: Path, name: str, frames: int, ate_m: float
) -> None:
    log = open_log(data_root / name)
    result = map_log(log, out=tmp_path / name)
    assert result.exit_code == 0  # a signal from outside ends a run early, and would look like lost frames here
    metrics = result.metrics
    assert (metrics["tracked"], metrics["lost"], len(log)) == (frames, 0, frames)
    assert metrics["ate_frames"] == frames
    assert metrics["ate_rmse_m"] <= ate_m
    assert (tmp_path / name / "report.html").exists()
    check_views(name, metrics)


def check_views(name: str, metrics: dict[str, Any]) -> None:
    """Held-out views of the recording that surrounds its scene; the others see parts of theirs only once."""
    assert metrics["held_out"] == metrics["frames"] // 8
    if name == "redkitchen_000_199":
        assert metrics["psnr_holdout_db"] >= 20.0
        assert metrics["depth_median_m"] <= 0.02
