"""The experiment on pruning: a compacted map misses nothing, a pruned one does."""

from __future__ import annotations

from pathlib import Path

from experiments.pruning import SHARES, measure
from splatbot.logs import open_log
from splatbot.run import map_log
from tests.rgbd import small_config


def test_the_map_of_a_run_is_pruned_and_compacted(tmp_path: Path) -> None:
    log = open_log("synthetic:tabletop?width=160&height=120&frames=9")
    map_log(log, out=tmp_path, config=small_config(), report=False)
    rows = measure(tmp_path, 20_000)
    assert [row.share for row in rows] == list(SHARES)
    for row in rows:
        assert row.hits > 10_000
        assert row.missed_by_compacted == 0
        assert row.missed_by_pruned > 0
        assert row.compacted_db > row.pruned_db
