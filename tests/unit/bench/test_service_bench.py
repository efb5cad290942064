"""The benchmark of the service queries a running service and counts the answers."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.bench.service import BENCHMARK, ServiceBenchSettings


@pytest.mark.long
@pytest.mark.alone
def test_queries_are_sent_at_fixed_times_and_all_are_answered(tmp_path: Path) -> None:
    values = {**ServiceBenchSettings.quick_values, "per_s": 4.0}
    results = BENCHMARK.run(ServiceBenchSettings(out=tmp_path, **values))
    case = "3 clients x 4/s"
    asked = results.find(case, "queries")
    assert asked is not None
    assert 18 <= asked <= 27
    assert results.find(case, "errors") == 0
    assert (results.find("no queries", "frames") or 0) > 5
    assert (results.find("1000 points", "npy over HTTP") or 0) > 0
    assert (tmp_path / "service.json").is_file()
