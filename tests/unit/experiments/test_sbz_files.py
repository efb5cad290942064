"""The experiment on SBZ files compares a map with its decoded one."""

from __future__ import annotations

from pathlib import Path

from experiments.sbz import compare
from splatbot.logs import open_log
from splatbot.run import map_log
from tests.rgbd import small_config


def test_the_map_of_a_run_is_compared_with_its_file(tmp_path: Path) -> None:
    log = open_log("synthetic:tabletop?width=160&height=120&frames=9")
    map_log(log, out=tmp_path, config=small_config(), report=False)
    found = compare(tmp_path, 30_000)
    assert found.gaussians > 1000
    assert 5 < found.bytes_each < 11
    assert 1.05 < found.growth < 1.13
    assert found.loss_db < 0.3
    assert found.loss_db <= found.worst_db
    assert 15_000 < found.hits <= found.spheres == 30_000
    assert found.missed == 0
