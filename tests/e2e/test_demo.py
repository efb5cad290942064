"""The demo distinguishes right from wrong maps; reference poses replace mapping, to arrange both."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.cli.demo import demo
from splatbot.config import Config
from splatbot.gaussians import Snapshot
from splatbot.logs import open_log
from tests.unit.oracle import OracleSlam

FRAMES = 4


def _slam_that_is_off_by(metres: float) -> type[OracleSlam]:
    reference = open_log(f"synthetic:tabletop?frames={FRAMES}").ground_truth

    class Shifted(OracleSlam):
        def __init__(self, config: Config) -> None:
            assert reference is not None
            super().__init__(reference, config)

        def snapshot(self) -> Snapshot:
            snapshot = super().snapshot()
            snapshot.model.means[:, 1] += metres
            return snapshot

    return Shifted


@pytest.mark.long
@pytest.mark.parametrize(("metres", "exit_code"), [(0.0, 0), (0.1, 1)])
def test_the_demo_fails_exactly_when_the_map_contradicts_the_scene(
    metres: float, exit_code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("splatbot.run.job.Slam", _slam_that_is_off_by(metres))
    assert demo(out=tmp_path, frames=FRAMES) == exit_code
    said = capsys.readouterr().out
    assert said.count("[right]") == 2 - exit_code
    assert said.count("[WRONG: it is occupied]") == exit_code
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert {"map.ply", "metrics.json", "trajectory.tum"} <= {path.name for path in tmp_path.iterdir()}
