"""A motion to be told of."""

from __future__ import annotations

import numpy as np

from splatbot.planning import Certificate, JointTrajectory


def swing() -> JointTrajectory:
    """Two joints that swing for a while; certified of nothing."""
    control = np.sin(np.linspace(0, 3, 12))[:, None] * np.array([1.0, -0.5])
    return JointTrajectory(("a", "b"), control, 0.1, Certificate(False, 1e-3, 0.0, 0.0, 1))
