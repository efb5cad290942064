"""Fixtures of the tests of planning."""

from __future__ import annotations

import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.robots.panda import panda


@pytest.fixture(scope="package")
def field() -> GaussianCollisionField:
    """The table top as 20,000 Gaussians."""
    return GaussianCollisionField(tabletop().gaussians(20_000))


@pytest.fixture(scope="package")
def arm() -> RobotSpheres:
    """The Panda."""
    return RobotSpheres(panda())
