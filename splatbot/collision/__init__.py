"""Where the robot may not go, asked of the Gaussians themselves."""

from splatbot.collision.answers import ClearanceResult, MahalanobisResult, NeighboursResult
from splatbot.collision.field import GaussianCollisionField

__all__ = ["ClearanceResult", "GaussianCollisionField", "MahalanobisResult", "NeighboursResult"]
