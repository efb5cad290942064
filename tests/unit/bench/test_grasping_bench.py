"""`splatbot bench grasping` in its quick form."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splatbot.bench.grasping import BENCHMARK, GraspingSettings
from splatbot.bench.results import Results
from splatbot.cli import main


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return BENCHMARK.run(GraspingSettings(out=tmp_path_factory.mktemp("grasping"), quick=True))


@pytest.mark.long
def test_every_case_has_its_figures(ran: Results) -> None:
    for case in ("10000 Gaussians", "50 samples", "100 samples"):
        for metric in ("to a ranked list, median", "candidates", "graspable objects with a grasp", "checked grasps"):
            assert (ran.find(case, metric) or 0) > 0, (case, metric)


def test_contacts_are_within_three_millimetres_of_the_exact_shapes(ran: Results) -> None:
    for case in ("10000 Gaussians", "50 samples", "100 samples"):
        off = ran.find(case, "distance of contacts to the true surface, 95 %")
        assert off is not None
        assert off < 3.0


@pytest.mark.long
def test_the_command_writes_its_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "grasping", "--quick", "--out", str(tmp_path), "--json", str(tmp_path / "f.json")]) == 0
    assert "to a ranked list" in capsys.readouterr().out
    rows = json.loads((tmp_path / "f.json").read_text())["rows"]
    assert {"case", "metric", "value", "unit"} <= set(rows[0])
    assert (tmp_path / "grasping.csv").is_file()
