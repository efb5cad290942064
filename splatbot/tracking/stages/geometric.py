"""Stage of projective point-to-plane alignment on the coarse pyramid levels."""

from __future__ import annotations

import numpy as np

from splatbot.tracking.align import SoftPrior, align
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage

_GATE_SCALE = 2  # times sensor.max_depth_difference: a predicted pose is worse than one that is nearly aligned


class GeometricStage(TrackingStage):
    """Point-to-plane alignment with the prediction as a prior (Chen and Medioni 1992; Newcombe et al. 2011).

    The information of the prediction is one more term of the normal equations. So the pose stays at the prediction in
    directions that depth does not constrain.
    """

    name = skipped_name = "geometric"

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True: the other stages begin with this pose."""
        return True

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work of alignment without the finest level."""
        return StageCost((self.name, problem.alignment_units(self._finest(problem))))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        """Align the frame to the keyframes of the hypothesis."""
        prediction = problem.prediction
        information = np.asarray(np.linalg.inv(prediction.covariance), dtype=np.float64)
        alignment = align(
            problem.prepared.levels,
            hypothesis.references,
            hypothesis.T_world_camera,
            problem.config,
            photometric=False,
            finest=self._finest(problem),
            gate=_GATE_SCALE * problem.config.sensor.max_depth_difference,
            prior=SoftPrior(prediction.T_world_camera, information),
        )
        return Hypothesis(self.name, alignment, hypothesis.keyframes)

    def _finest(self, problem: TrackingProblem) -> int:
        return min(1, problem.n_levels - 1)
