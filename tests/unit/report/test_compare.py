"""The page of two maps: it is whole in one file, and names are text."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np

from splatbot.report.compare import PageMap, compare_html, comparison_rows
from splatbot.training.comparison import compare_around, summary
from tests.unit.training.rendered import true_model

A = PageMap("a<script>.ply", 80, 0, 4_000)
B = PageMap("b.spz", 40, 0, 1_000)


def page(notes: tuple[str, ...] = ()) -> str:
    views = list(compare_around(true_model(), true_model(20), 2))
    return compare_html(A, B, views, summary(views), notes)


def test_the_page_needs_no_other_file() -> None:
    text = page()
    assert not re.findall(r'(?:src|href)="(?!data:)', text)
    assert text.count('type="range"') == 4  # colour and depth of each view


def test_a_slider_lies_on_two_images_of_one_size() -> None:
    found = re.search(r'class="swipe".*?base64,([^"]+)".*?base64,([^"]+)"', page(), re.S)
    assert found is not None
    a, b = (cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR) for data in found.groups())
    assert a is not None
    assert b is not None
    assert a.shape == b.shape
    assert np.abs(a.astype(int) - b).max() > 30


def test_names_are_text_and_notes_are_shown() -> None:
    text = page(("The maps do not overlap.",))
    assert "<script>" not in text
    assert "a&lt;script&gt;.ply" in text
    assert "The maps do not overlap." in text


def test_scores_against_a_recording_have_rows_where_there_is_one() -> None:
    means = {"psnr_db": 30.0, "ssim": 0.9, "covered_a": 1.0, "covered_b": 0.5}
    names = [row[0] for row in comparison_rows(A, B, means)]
    assert "PSNR against the recording" not in names
    scored = means | {"psnr_a_db": 25.0, "ssim_a": 0.8, "psnr_b_db": None, "ssim_b": None}
    assert ("PSNR against the recording", "25.0 dB", "-") in comparison_rows(A, B, scored)
    assert "median error to measured depth" not in [row[0] for row in comparison_rows(A, B, scored)]
    measured = scored | {"depth_error_a": 0.0031, "depth_error_b": None, "measured_a": 0.9, "measured_b": 0.0}
    assert ("median error to measured depth", "3.10 mm", "-") in comparison_rows(A, B, measured)
