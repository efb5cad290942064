"""Where the robot may not go, asked of the Gaussians themselves."""

from splatbot.collision.answers import ClearanceResult, MahalanobisResult, NeighboursResult
from splatbot.collision.evidence import Evidence, gather_evidence
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.robot import ArmClearanceResult, ConfigurationResult, EdgeResult, RobotSpheres

__all__ = [
    "ArmClearanceResult",
    "ClearanceResult",
    "ConfigurationResult",
    "EdgeResult",
    "Evidence",
    "GaussianCollisionField",
    "MahalanobisResult",
    "NeighboursResult",
    "RobotSpheres",
    "gather_evidence",
]
