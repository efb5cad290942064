"""A motion to publish."""

from __future__ import annotations

import numpy as np

from splatbot.planning import Certificate, JointTrajectory


def swing() -> JointTrajectory:
    """Return a trajectory of two swinging joints, without a certificate."""
    control = np.sin(np.linspace(0, 3, 12))[:, None] * np.array([1.0, -0.5])
    return JointTrajectory(("a", "b"), control, 0.1, Certificate(False, 1e-3, 0.0, 0.0, 1))
