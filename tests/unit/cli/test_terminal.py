"""Commands at a terminal: users have a terminal, while most tests use a pipe."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.terminal import at_a_terminal

LOG = "synthetic:tabletop?frames=12&width=160&height=120"


@pytest.mark.parametrize("columns", [80, pytest.param(200, marks=pytest.mark.long)])
def test_map_shows_progress_and_ends_with_its_summary(tmp_path: Path, columns: int) -> None:
    shown = at_a_terminal("map", LOG, "--out", str(tmp_path / "run"), columns=columns)
    assert shown.code == 0, shown.text
    assert "Traceback" not in shown.text
    assert shown.live
    assert "12/12" in shown.text
    assert "refining" in shown.text
    assert "saving" in shown.text
    assert "frames tracked" in shown.text
    assert shown.colours
    assert shown.longest_line() <= columns
    assert (tmp_path / "run" / "report.html").exists()


@pytest.mark.long
def test_without_colour_and_with_a_terminal_that_changes_its_width_map_goes_on(tmp_path: Path) -> None:
    shown = at_a_terminal(
        "map",
        LOG,
        "--out",
        str(tmp_path / "run"),
        columns=200,
        resize_at=("2/12", 80),
        environment={"NO_COLOR": "1"},
    )
    assert shown.code == 0, shown.text
    assert not shown.colours
    assert "12/12" in shown.text


def test_ctrl_c_at_a_terminal_saves_what_was_mapped(tmp_path: Path) -> None:
    log = LOG.replace("frames=12", "frames=400")
    shown = at_a_terminal("map", log, "--out", str(tmp_path / "run"), columns=80, interrupt_at="/400")
    assert shown.code == 130, shown.text
    assert "Traceback" not in shown.text
    assert "interrupted; saved" in shown.text
    assert (tmp_path / "run" / "map.ply").exists()
