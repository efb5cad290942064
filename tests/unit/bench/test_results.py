"""Results of a benchmark in files, and plots that are drawn again from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results, Row
from splatbot.cli import main
from splatbot.errors import InputError

ROWS = [
    Row("desk, 30 ms", "ATE", 3.0, "mm"),
    Row("desk, 30 ms", "p50", 20.0, "ms"),
    Row("desk, 100 ms", "ATE", 2.0, "mm"),
    Row("desk, 100 ms", "p50", 40.0, "ms"),
    Row("desk, 100 ms", "NEES / 6", None, "", note="fewer than ten frames"),
]
MACHINE = {"cpu": "a CPU", "cpus": 2, "isa": "v3", "fma_peak_gflops": {"v3": {"1": 50.0}}, "load_1min": 0.1}


def test_written_results_are_read_as_they_were(tmp_path: Path) -> None:
    results = Results(
        MACHINE, [*ROWS, Row("a", "b", 1.0, "ms", spread=0.1, peer="other")], {"(default)": [[1.0, 20.5]]}
    )
    results.write_json(tmp_path / "a.json")
    assert Results.read_json(tmp_path / "a.json") == results


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"machine": {}, "rows": [{"case": 1}]}', '{"machine": {}, "rows": 3}']
)
def test_a_damaged_file_is_named_with_the_fix(text: str, tmp_path: Path) -> None:
    (tmp_path / "tracking.json").write_text(text)
    with pytest.raises(InputError, match=r"tracking\.json.*Fix:"):
        Results.read_json(tmp_path / "tracking.json")


def test_redraw_draws_the_plot_of_saved_results_and_prints_their_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Results(MACHINE, ROWS).write_json(tmp_path / "tracking.json")
    before = (tmp_path / "tracking.json").read_bytes()
    assert main(["bench", "tracking", "--redraw", "--out", str(tmp_path)]) == 0
    assert "desk" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"tracking.json", "tracking.png", "tracking.svg"}
    assert (tmp_path / "tracking.json").read_bytes() == before


def test_redraw_without_results_names_the_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "planning", "--redraw", "--out", str(tmp_path)]) == 2
    assert "planning.json" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["training", "sizing"])
def test_redraw_of_results_of_another_version_names_the_file(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Results(MACHINE, [Row("a b", "time", None, "ms")], {"x": [1]}).write_json(tmp_path / f"{name}.json")
    assert main(["bench", name, "--redraw", "--out", str(tmp_path)]) == 2
    assert f"{name}.json" in "".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("kept", [(), ("a.json",), ("results.txt",)])
def test_ctrl_c_leaves_a_folder_only_if_it_has_results_or_was_there_before(
    tmp_path: Path, kept: tuple[str, ...]
) -> None:
    class ASettings(Settings):
        name = "a"

    folder = tmp_path / "out"
    if "results.txt" in kept:
        folder.mkdir()
        (folder / "results.txt").touch()

    def measure(settings: Settings, report_progress: ReportProgress) -> Results:
        (settings.folder / "service.log").touch()
        if "a.json" in kept:
            settings.save(Results(MACHINE))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Benchmark(ASettings, measure, ()).run(ASettings(out=folder))
    assert folder.exists() == bool(kept)
    assert all((folder / name).exists() for name in kept)
