"""Counts, percentiles and numbers as people read them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from splatbot.results.folder import FrameRow
from splatbot.results.metrics import cost_metrics, percentiles, stage_names, without_nan
from splatbot.results.units import count, decibels, megabytes, metres, milliseconds, number, percent

ROWS = [
    FrameRow(0, 0.0, "ok", ms=10.0, stage_ms={"prepare": 1.0, "mapping": 9.0}, keyframe=True),
    FrameRow(1, 0.1, "degraded", ("dark",), ms=4.0, stage_ms={"prepare": 1.0, "direct": 2.0, "mapping": 1.0}),
    FrameRow(2, 0.2, "lost", ("blur",), ms=3.0, stage_ms={"prepare": 3.0}, held_out=True),
    FrameRow(3, None, "skipped", ("damaged",)),
]


def test_frames_that_could_not_be_read_count_as_skipped_only() -> None:
    metrics = cost_metrics(ROWS)
    expected = {"frames": 3, "tracked": 2, "degraded": 1, "lost": 1, "skipped": 1, "keyframes": 1, "held_out": 1}
    assert {name: metrics[name] for name in expected} == expected
    assert metrics["ms_per_frame"]["p50"] == 4.0


def test_a_stage_is_measured_over_the_frames_in_which_it_ran() -> None:
    stages = cost_metrics(ROWS)["stages"]
    assert (stages["direct"]["frames"], stages["direct"]["p99"], stages["direct"]["total"]) == (1, 2.0, 2.0)
    assert (stages["prepare"]["frames"], stages["prepare"]["p50"], stages["prepare"]["total"]) == (3, 1.0, 5.0)


def test_stages_are_in_the_order_of_the_fullest_frame() -> None:
    assert stage_names(ROWS) == ["prepare", "direct", "mapping"]


def test_percentiles_are_numpys() -> None:
    values = list(np.random.default_rng(3).exponential(size=101))
    assert list(percentiles(values).values()) == [float(np.percentile(values, p)) for p in (50, 95, 99)]
    assert percentiles([]) == {"p50": None, "p95": None, "p99": None}


def test_numbers_that_json_lacks_become_null() -> None:
    cleaned = without_nan({"a": math.inf, "b": [math.nan, 1.5], "c": {"d": -math.inf}, "e": "inf", "f": 3})
    assert cleaned == {"a": None, "b": [None, 1.5], "c": {"d": None}, "e": "inf", "f": 3}
    json.dumps(cleaned, allow_nan=False)


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (metres(0.00123), "1.23 mm"),
        (metres(0.0456), "4.56 cm"),
        (metres(7.891), "7.89 m"),
        (metres(None), "-"),
        (milliseconds(4.56), "4.6 ms"),
        (milliseconds(456.7), "457 ms"),
        (milliseconds(45670.0), "45.7 s"),
        (decibels(21.04), "21.0 dB"),
        (percent(0.714), "71 %"),
        (count(1234567), "1,234,567"),
        (megabytes(12_345_678), "12.3 MB"),
        (megabytes(1_234), "1.2 kB"),
        (megabytes(2_500_000_000), "2.50 GB"),
        (number(0.12345, 3), "0.123"),
        (number(None, 3), "-"),
    ],
)
def test_numbers_are_short_and_carry_their_unit(shown: str, text: str) -> None:
    assert shown == text
