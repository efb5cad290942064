"""Stage that moves the last known pose by the motion prior or the robot prior."""

from __future__ import annotations

from splatbot.tracking.align import Alignment
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage


class PredictStage(TrackingStage):
    """Return the predicted pose of the frame."""

    name = skipped_name = "predict"

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True: every alignment begins with the prediction."""
        return True

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Return no work: the motion model predicts before the stages run."""
        return StageCost(None)

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        """Return the hypothesis at the predicted pose with the keyframes nearest to it."""
        T_world_camera = problem.prediction.T_world_camera
        return Hypothesis(self.name, Alignment.unconstrained(T_world_camera), problem.nearest(T_world_camera))
