"""A log of consecutive recordings plays each of them in turn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs import open_log

A = "synthetic:tabletop?frames=3&width=80&height=60"
B = "synthetic:tabletop?frames=2&width=80&height=60&trajectory=arm"


def _file(folder: Path, text: str) -> Path:
    file = folder / "recordings.yaml"
    file.write_text(text)
    return file


def test_frames_follow_each_other_with_their_own_images_and_shifted_stamps(tmp_path: Path) -> None:
    file = _file(tmp_path, f'recordings: [{{log: "{A}"}}, {{log: "{B}", time_offset: 10.0}}]')
    log, a, b = open_log(file), open_log(A), open_log(B)
    assert len(log) == 5
    assert [frame.index for frame in log] == [0, 1, 2, 3, 4]
    assert [frame.stamp for frame in log] == pytest.approx([0, 1 / 30, 2 / 30, 10, 10 + 1 / 30])
    np.testing.assert_array_equal(log[2].depth, a[2].depth)
    np.testing.assert_array_equal(log[4].rgb, b[1].rgb)
    assert log.ground_truth is not None
    assert len(log.ground_truth) == 3  # those of the first recording: others may have another world


def test_a_path_is_relative_to_the_file(tmp_path: Path) -> None:
    inner = _file(tmp_path, f'recordings: [{{log: "{A}"}}]')
    outer = tmp_path / "outer.yaml"
    outer.write_text(f'recordings: [{{log: {inner.name}}}, {{log: "{B}", time_offset: 1.0}}]')
    assert len(open_log(outer)) == 5


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("recordings: []", "recordings"),
        ("recordings: [1]", "recordings[0]"),
        (f'recordings: [{{log: "{A}", mask: b}}]', "recordings[0]"),
        (f'recordings: [{{log: "{A}", time_offset: soon}}]', "recordings[0].time_offset"),
        (f'recordings: [{{log: "{A}", camera: 3}}]', "recordings[0].camera"),
        (f'recordings: [{{log: "{A}"}}, {{log: "{B}"}}]', "recordings[1]"),
    ],
)
def test_a_wrong_list_is_refused_with_the_field(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(LogError) as caught:
        open_log(_file(tmp_path, text))
    assert caught.value.field == field
    assert caught.value.hint


def test_a_camera_for_all_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="its own"):
        open_log(_file(tmp_path, f'recordings: [{{log: "{A}"}}]'), camera="tum_fr1")
