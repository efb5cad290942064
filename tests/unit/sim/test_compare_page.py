"""The page of policies in two twins: heading, intervals, certified clearances and failures."""

from __future__ import annotations

import re

import numpy as np

from splatbot.sim.compare.page import policy_rows, promise_rows, silhouettes, trials_html, trials_title
from splatbot.sim.compare.plots import policies_plot
from splatbot.sim.compare.trials import Trial, TrialResults


def _results(policies: tuple[str, ...], *, interrupted: bool = False) -> TrialResults:
    trials = [
        Trial(
            name,
            case,
            False,
            k > 0,
            k > 0 and case > k,
            0.004 * k,
            0.02,
            0.006,
            why_held_out="" if k else "touched <b>",
        )
        for k, name in enumerate(policies)
        for case in range(6)
    ]
    return TrialResults("reach", policies, tuple(trials), interrupted)


def test_the_page_names_both_twins_and_every_policy_and_nothing_real() -> None:
    found = _results(("straight", "careful", "bold"))
    page = trials_html([found])
    assert "sim-to-sim" in page
    assert "sim-to-real" not in page
    assert trials_title(found).startswith("sim-to-sim: reach")
    for name in found.policies:
        assert f"<td>{name}</td>" in page
    assert "touched &lt;b&gt;" in page
    assert "Interrupted" not in page
    assert re.search(r'src="(?!data:)', page) is None  # nothing is fetched


def test_shares_and_measures_come_with_their_intervals() -> None:
    rows = policy_rows(_results(("straight", "careful", "bold")))
    assert rows[1][1] == "100 % (61 % to 100 %)"  # Wilson's, of 6 of 6
    assert [row[0] for row in rows[3:]] == ["mean drop", "Pearson r", "mean maximum rank violation"]
    assert all(re.search(r"\d\.\d\d \(-?\d\.\d\d to -?\d\.\d\d\)", row[3]) for row in rows)
    promises = promise_rows(_results(("straight", "careful", "bold")))
    assert [row[0] for row in promises] == ["0 to 5 mm", "5 to 10 mm"]
    assert promises[1][6] == "-2.0 mm"


def test_without_a_whole_case_the_page_says_that_it_was_stopped() -> None:
    page = trials_html([TrialResults("push", ("a",), (), interrupted=True)])
    assert "Interrupted" in page
    assert policy_rows(TrialResults("push", ("a",), ())) == []


def test_the_plot_is_a_picture_even_where_no_figure_varies() -> None:
    found = _results(("straight",)).agreement()
    assert found is not None
    assert policies_plot(found).startswith(b"\x89PNG")


def test_silhouettes_tell_both_from_either() -> None:
    a, b = np.array([[True, True, False, False]]), np.array([[True, False, True, False]])
    colours = {tuple(pixel) for pixel in silhouettes(a, b)[0].tolist()}
    assert len(colours) == 4
    assert tuple(silhouettes(a, b)[0, 3]) == (0, 0, 0)
