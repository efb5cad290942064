"""The benchmark of the service asks a real one and counts what comes back."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.bench.service import ServicePlan, run_service_bench

PLAN = ServicePlan("synthetic:tabletop?frames=6&width=160&height=120&arc=4", 10.0, 3, 4.0, 100, 2.0, 1000)


@pytest.mark.long
def test_questions_are_asked_at_their_times_and_all_answered(tmp_path: Path) -> None:
    results = run_service_bench(PLAN, tmp_path)
    case = "3 clients x 4/s"
    asked = results.find(case, "questions")
    assert asked is not None
    assert 18 <= asked <= 27
    assert results.find(case, "errors") == 0
    assert (results.find("no questions", "frames") or 0) > 5
    assert (results.find("1000 points", "npy over HTTP") or 0) > 0
    assert (tmp_path / "service.json").is_file()
