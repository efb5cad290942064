"""Where the robot may not go, asked of the Gaussians themselves."""

from splatbot.collision.field import GaussianCollisionField, MahalanobisResult

__all__ = ["GaussianCollisionField", "MahalanobisResult"]
