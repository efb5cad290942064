"""The curves of a training."""

from __future__ import annotations

import numpy as np

from splatbot.services.live_training.course import MOST_POINTS, TrainingCourse
from splatbot.training.folder import ProgressRow


def test_a_point_is_the_mean_of_its_interval() -> None:
    course = TrainingCourse([])
    for step in range(1, 9):
        course.note(float(step), step / 4, 10 * step)
    assert [(p.seconds, p.loss, p.gaussians, p.steps_per_s) for p in course.points] == [
        (1.0, 2.5, 40, 4.0),
        (2.0, 6.5, 80, 4.0),
    ]


def test_a_long_training_keeps_a_bounded_curve_of_all_its_time_with_the_same_mean() -> None:
    course, losses = TrainingCourse([]), np.linspace(1.0, 0.0, 4000)
    for second, loss in enumerate(losses, start=1):
        course.note(float(loss), float(second), second)
        assert len(course.points) < MOST_POINTS
    gaps = np.diff([point.seconds for point in course.points])
    assert len(set(gaps)) == 1
    covered = int(course.points[-1].seconds)
    assert covered > 4000 - gaps[0]
    np.testing.assert_allclose(np.mean([point.loss for point in course.points]), losses[:covered].mean(), rtol=1e-9)
    assert {point.steps_per_s for point in course.points} == {1.0}


def test_a_resumed_training_begins_with_the_rows_of_the_earlier_part() -> None:
    rows = [ProgressRow(100, 10.0, 0.5, 20.0, 7), ProgressRow(400, 20.0, 0.25, 22.0, 9)]
    course = TrainingCourse(rows)
    assert [point.steps_per_s for point in course.points] == [10.0, 30.0]
    course.note(0.125, 22.0, 11)
    assert (course.points[-1].seconds, course.points[-1].steps_per_s) == (22.0, 0.5)
