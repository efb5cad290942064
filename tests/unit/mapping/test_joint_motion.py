"""Joint motion: joints below a speed count as still."""

from __future__ import annotations

import numpy as np

from splatbot.mapping.joint_motion import JointMotionMonitor


def test_one_joint_that_moves_faster_than_the_bound_is_motion() -> None:
    motion = JointMotionMonitor(0.05)
    assert not motion.update(0.0, np.zeros(3))
    assert motion.update(0.1, np.array([0.0, -0.006, 0.0]))
    assert not motion.update(0.2, np.array([0.004, -0.006, 0.0]))


def test_without_joints_or_with_a_stopped_clock_the_robot_counts_as_still() -> None:
    motion = JointMotionMonitor(0.05)
    assert not motion.update(0.0, None)
    assert not motion.update(0.1, np.ones(3))
    assert not motion.update(0.1, np.zeros(3))
    assert not motion.update(0.2, None)
    assert not motion.update(0.3, np.ones(3))
    assert not motion.update(0.4, np.zeros(2))


def test_the_caller_may_reuse_its_array() -> None:
    motion, joints = JointMotionMonitor(0.05), np.zeros(2)
    motion.update(0.0, joints)
    joints += 1.0
    assert motion.update(0.1, joints)
