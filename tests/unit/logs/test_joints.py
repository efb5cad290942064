"""Joints of a log: read, in between, and not known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.logs import open_log
from splatbot.logs.joints import JointRecord
from splatbot.logs.record import record


def written(folder: Path, text: str) -> JointRecord:
    path = folder / "joints.txt"
    path.write_text(text)
    return JointRecord(path)


def test_joints_are_linear_in_between_and_unknown_far_from_any_line(tmp_path: Path) -> None:
    joints = written(tmp_path, "# s rad rad\n1.00 0.0 2.0\n1.05 0.1 1.0\n2.00 0.5 0.0\n")
    for stamp, expected in ((1.0, [0.0, 2.0]), (1.02, [0.04, 1.6]), (0.95, [0.0, 2.0]), (2.05, [0.5, 0.0])):
        found = joints.at(stamp)
        assert found is not None
        np.testing.assert_allclose(found, expected, atol=1e-12)
    for stamp in (0.8, 1.5, 1.1, 2.2):  # between 1.05 and 2 s lies a gap
        assert joints.at(stamp) is None


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("1.0 0.0\n1.0 0.1\n", 2, "not after"),
        ("1.0 0.0 0.1\n1.1 0.0\n", 2, "malformed"),
        ("1.0 nan\n", 1, "malformed"),
        ("1.0\n", 1, "malformed"),
        ("# nothing\n", None, "empty"),
    ],
)
def test_a_damaged_file_is_refused_by_line(tmp_path: Path, text: str, line: int | None, message: str) -> None:
    with pytest.raises(LogError, match=message) as caught:
        written(tmp_path, text)
    assert caught.value.field == (line and f"line {line}")
    assert caught.value.file is not None


def test_recorded_joints_are_read_with_their_frames(make_log: Callable[..., Path], tmp_path: Path) -> None:
    frames = [replace(f, joints=np.array([0.1 * k, -0.3])) for k, f in enumerate(open_log(str(make_log(4))))]
    again = open_log(str(record(frames, tmp_path / "again")))
    for frame, known in zip(again, frames, strict=True):
        assert frame.joints is not None
        assert known.joints is not None
        np.testing.assert_array_equal(frame.joints, known.joints)
