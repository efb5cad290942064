"""Documented figures: each is in its document, and its check fails where it should."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.figures import Figure, figures

_ALL = [figure for _, found in figures() for figure in found]


@pytest.mark.parametrize("figure", _ALL, ids=lambda figure: f"{figure.doc}: {figure.text}")
def test_a_figure_is_in_its_document(figure: Figure) -> None:
    assert figure.stands()
    assert not replace(figure, value=figure.value + 1).stands()


def test_a_value_is_found_in_the_output_of_its_command() -> None:
    figure = Figure("README.md", "{}", 0.5, r"ATE RMSE +(\S+) mm", 0.1)
    assert figure.measured("  ATE RMSE               0.45 mm  over 48 frames") == 0.45
    assert figure.measured("nothing") is None
