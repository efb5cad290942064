"""Collision queries of points, bodies and robots against a map of Gaussians."""

from splatbot.collision.answers import ClearanceResult, MahalanobisResult, NeighboursResult
from splatbot.collision.bodies import boxes_in_collision, capsules_in_collision
from splatbot.collision.esdf import Esdf, esdf
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.margin import SurfaceError, surface_error
from splatbot.collision.moving import find_moving
from splatbot.collision.probability import ProbabilityResult, collision_probability
from splatbot.collision.robot import ArmClearanceResult, ConfigurationResult, EdgeResult, RobotSpheres
from splatbot.collision.unknown import UnknownSpace, find_unknown
from splatbot.collision.visibility import VisibilityEvidence, evidence_at, gather_evidence

__all__ = [
    "ArmClearanceResult",
    "ClearanceResult",
    "ConfigurationResult",
    "EdgeResult",
    "Esdf",
    "GaussianCollisionField",
    "MahalanobisResult",
    "NeighboursResult",
    "ProbabilityResult",
    "RobotSpheres",
    "SurfaceError",
    "UnknownSpace",
    "VisibilityEvidence",
    "boxes_in_collision",
    "capsules_in_collision",
    "collision_probability",
    "esdf",
    "evidence_at",
    "find_moving",
    "find_unknown",
    "gather_evidence",
    "surface_error",
]
