"""Hard logs: every frame is within a bound of the truth, or is reported; what nobody can see changes no map."""

from __future__ import annotations

from functools import cache

import pytest

from splatbot.bench.machine import describe_machine
from splatbot.bench.results import Results
from splatbot.bench.stress import CASES, LOST, RECOVERY, SILENT, VIEWS, StressCase, StressFigures, run_case, run_stress
from tests.rgbd import small_config

FRAMES = 45
WIDTH = 160
BY_NAME = {case.name: case for case in CASES}
ALL = pytest.mark.parametrize("name", BY_NAME)
STRETCHES = pytest.mark.parametrize("name", [case.name for case in CASES if case.stretch is not None])


@cache
def run(name: str) -> StressFigures:
    return run_case(BY_NAME[name], FRAMES, WIDTH, small_config())


@ALL
def test_no_frame_is_wrong_without_a_word(name: str) -> None:
    found = run(name)
    assert found.silent == 0, f"worst {1e3 * found.worst_m:.1f} mm"


@pytest.mark.parametrize("name", [case.name for case in CASES if case.stretch is None and "blank" not in case.name])
def test_what_can_be_tracked_is_tracked(name: str) -> None:
    assert run(name).count("lost") == 0


def test_a_blank_wall_is_never_called_ok() -> None:
    assert run("flat blank wall").count("ok") <= 1  # the first frame, which defines the world


@STRETCHES
def test_a_second_of_good_frames_is_enough_to_track_again(name: str) -> None:
    found = run(name)
    assert found.recovery is not None
    assert found.recovery <= BY_NAME[name].rate
    assert found.after_m <= BY_NAME[name].bound_m


@STRETCHES
def test_the_map_shows_what_it_showed_before_the_bad_stretch(name: str) -> None:
    found = run(name)
    assert found.worse_db < 0.5


def test_frames_without_anything_to_see_are_lost_and_change_no_bit_of_the_map() -> None:
    case = BY_NAME["0.5 s of black frames"]
    first, good = case.bad(FRAMES)
    found = run(case.name)
    assert {r.verdict for r in found.results[first:good]} == {"lost"}
    assert found.same_map


def test_the_table_has_a_row_for_each_figure() -> None:
    results = Results(describe_machine((1,), peak_ms=1))
    case = StressCase("black", "tabletop?effects=blackout:at={at},n={n}", 0.005, (0.5, 0.75))
    run_stress(results, small_config(), frames=12, width=160, cases=(case,))
    figures = {row.metric: row for row in results.rows}
    assert figures[SILENT].value == 0
    value = figures[LOST].value
    assert value is not None
    assert value >= 3
    assert figures[RECOVERY].value is not None
    assert figures[VIEWS].note == "the same bits"
