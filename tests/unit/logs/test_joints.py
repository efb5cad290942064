"""Joints of a log: read, in between, and not known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.errors import InputError, LogError
from splatbot.logs import open_log
from splatbot.logs.joints import JointRecord, JointStates, select_joints
from splatbot.logs.mcap import record_mcap
from splatbot.logs.record import record


def written(folder: Path, text: str) -> JointRecord:
    path = folder / "joints.txt"
    path.write_text(text)
    return JointRecord(path)


def test_joints_are_linear_in_between_and_unknown_far_from_any_line(tmp_path: Path) -> None:
    joints = written(tmp_path, "# s rad rad\n1.00 0.0 2.0\n1.05 0.1 1.0\n2.00 0.5 0.0\n")
    for stamp, expected in ((1.0, [0.0, 2.0]), (1.02, [0.04, 1.6]), (0.985, [0.0, 2.0]), (2.015, [0.5, 0.0])):
        found = joints.at(stamp)
        assert found is not None
        np.testing.assert_allclose(found, expected, atol=1e-12)
    for stamp in (0.8, 0.95, 1.5, 1.1, 2.05, 2.2):  # between 1.05 and 2 s lies a gap
        assert joints.at(stamp) is None


def test_positions_hold_for_20_ms_from_a_line_also_at_6_hz(tmp_path: Path) -> None:
    joints = written(tmp_path, "1.000 0.0\n1.167 0.1\n1.333 0.2\n")
    for stamp, expected in ((1.167, 0.1), (1.185, 0.1), (1.149, 0.1)):
        np.testing.assert_allclose(joints.at(stamp), [expected])  # type: ignore[arg-type]
    assert joints.at(1.19) is None


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("1.0 0.0\n1.0 0.1\n", 2, "not after"),
        ("1.0 0.0 0.1\n1.1 0.0\n", 2, "malformed"),
        ("1.0 nan\n", 1, "malformed"),
        ("1.0\n", 1, "malformed"),
        ("# nothing\n", None, "empty"),
        ("# of the left arm\n# stamp [s] a\n1.0 0.5\n", "# stamp", "names 2 of 1 columns"),
    ],
)
def test_a_damaged_file_is_refused_by_line(tmp_path: Path, text: str, line: int | str | None, message: str) -> None:
    with pytest.raises(LogError, match=message) as caught:
        written(tmp_path, text)
    assert caught.value.field == (f"line {line}" if isinstance(line, int) else line)
    assert caught.value.file is not None


def test_recorded_joints_are_read_with_their_frames(make_log: Callable[..., Path], tmp_path: Path) -> None:
    frames = [replace(f, joints=np.array([0.1 * k, -0.3])) for k, f in enumerate(open_log(str(make_log(4))))]
    again = open_log(str(record(frames, tmp_path / "again")))
    for frame, known in zip(again, frames, strict=True):
        assert frame.joints is not None
        assert known.joints is not None
        np.testing.assert_array_equal(frame.joints, known.joints)


def test_a_folder_has_the_joints_at_the_times_of_colour_and_of_depth_also_of_the_last_frame(
    make_log: Callable[..., Path], tmp_path: Path
) -> None:
    def at(stamp: float) -> NDArray[np.float64]:
        return np.array([np.sin(90 * stamp), np.cos(70 * stamp)])

    delays = [0.03, -0.015, 0.02, 0.0, 0.035]  # the last depth image is 35 ms later than any joints of colour
    frames = [
        replace(f, depth_delay=delay, joints=at(f.stamp), joint_names=("a", "b"), depth_joints=at(f.stamp + delay))
        for f, delay in zip(open_log(str(make_log(5, period=0.05))), delays, strict=True)
    ]
    unknown = replace(frames[2], depth_joints=np.array([0.1, np.nan]))
    folder = record([*frames[:2], unknown, *frames[3:]], tmp_path / "again")
    for k, (read, frame) in enumerate(zip(open_log(f"{folder}?pair_within=0.04"), frames, strict=True)):
        assert read.joints is not None
        np.testing.assert_allclose(read.joints, at(frame.stamp), atol=1e-12)
        if k in (0, 1, 4):
            assert read.depth_joints is not None
            np.testing.assert_allclose(read.depth_joints, at(frame.stamp + frame.depth_delay), atol=1e-12)
    assert len(JointRecord(folder / "joints.txt").stamps) == 8  # not at the time of the third depth image


def test_names_of_joints_survive_a_recording_and_give_the_robots_order(
    make_log: Callable[..., Path], tmp_path: Path
) -> None:
    frames = [
        replace(f, joints=np.array([0.3, 0.1 * k, 0.2]), joint_names=("finger", "b", "a"))
        for k, f in enumerate(open_log(str(make_log(4))))
    ]
    frames[2] = replace(frames[2], joints=np.array([0.2, 0.2]), joint_names=("a", "b"))  # the finger was silent
    folder = record(frames, tmp_path / "again")
    assert JointRecord(folder / "joints.txt").names == ("finger", "b", "a")
    np.testing.assert_allclose(
        JointRecord(folder / "joints.txt").ordered(("a", "b")), [[0.2, 0.0], [0.2, 0.1], [0.2, 0.3]]
    )
    for log in (open_log(str(folder)), open_log(str(record_mcap(open_log(str(folder)), tmp_path / "a.mcap")))):
        first = log[1]
        assert first.joints is not None
        np.testing.assert_allclose(select_joints(first.joint_names, first.joints, ("a", "b")), [0.2, 0.1], atol=1e-12)


def test_a_delay_of_joint_states_is_taken_back_when_a_log_is_read(
    make_log: Callable[..., Path], tmp_path: Path
) -> None:
    folder = make_log(4)
    stamps = np.arange(-1.0, 2.0, 0.02) + open_log(str(folder))[0].stamp
    (folder / "joints.txt").write_text("".join(f"{t!r} {t - 0.1!r}\n" for t in stamps.tolist()))
    for frame in open_log(str(folder), joint_delay=0.1):
        assert frame.joints is not None
        assert frame.joints[0] == pytest.approx(frame.stamp, abs=1e-9)


def test_the_joints_of_several_publishers_come_together_each_at_its_own_rate() -> None:
    begin = 10.0
    states = JointStates(
        [(begin + 0.01 * k, ("b", "a"), np.array([-k, float(k)])) for k in range(20)]
        + [(begin + 0.1 * k, ("finger",), np.array([0.04])) for k in range(2)]
        + [(begin, ("a",), np.array([np.nan])), (begin, ("a", "b"), np.array([1.0])), (begin, (), np.zeros(0))]
    )
    names, q = states.at(begin + 0.055) or ((), np.zeros(0))
    assert dict(zip(names, q.tolist(), strict=True)) == pytest.approx({"a": 5.5, "b": -5.5, "finger": 0.04})
    names, q = states.at(begin + 0.205) or ((), np.zeros(0))  # the finger was silent for longer
    assert set(names) == {"a", "b"}
    assert states.at(begin + 1.0) is None
    assert JointStates([]).at(begin) is None


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ((), [1.0, 2.0]),
        (("joint1", "joint2", "joint3"), [1.0, 2.0]),
        (("q0", "q1", "q2"), [1.0, 2.0]),
        (("b", "x", "a"), [3.0, 1.0]),
        (("joint2", "joint1", "joint3"), None),
        (("a", "x", "y"), None),
        (("left_1", "left_2", "left_3"), None),
    ],
)
def test_joints_are_selected_by_name_or_by_number_and_never_by_chance(
    names: tuple[str, ...], expected: list[float] | None
) -> None:
    positions = np.array([1.0, 2.0, 3.0])
    if expected is None:
        with pytest.raises(InputError, match="has no joint"):
            select_joints(names, positions, ("a", "b"))
    else:
        assert select_joints(names, positions, ("a", "b")).tolist() == expected
