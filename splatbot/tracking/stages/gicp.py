"""Stage of G-ICP registration: the largest basin of convergence, for frames without a pose from features."""

from __future__ import annotations

from splatbot.tracking.gicp import GicpRegistration
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage


class GicpStage(TrackingStage):
    """Registration of the frame's point cloud with that of the nearest keyframe (Segal et al. 2009)."""

    name = skipped_name = "gicp"
    refinements, scorings = 2, 1

    def __init__(self) -> None:
        self._registration = GicpRegistration()

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the start is uncertain and features led to no pose."""
        return problem.is_uncertain and problem.matches is None and problem.config.gicp == "needed"

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Return the number of points."""
        return StageCost(("gicp", problem.config.gicp_points))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis | None:
        """Register the frame with the keyframe nearest to the prediction."""
        n_points, keyframe = problem.config.gicp_points, hypothesis.keyframes[0]
        T = self._registration.register(problem.prepared, keyframe, hypothesis.T_world_camera, n_points)
        return None if T is None else problem.hypothesis(self.name, T)
