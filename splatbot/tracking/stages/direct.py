"""Stage of direct alignment: photometric, depth and reprojection residuals down to the finest pyramid level."""

from __future__ import annotations

from collections.abc import Sequence

from splatbot.tracking.align import align
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import EFFORT_SHARES, StageCost, TrackingProblem, TrackingStage

# Standard deviation of the displacement of a blurred corner over the length of the blur: that of a uniform
# distribution. Corners that are visible at one end of the blur alone lie that far from its middle.
_BLUR_SHARE = 1 / 12**0.5

_FIXED_STEPS = 3  # cost of an alignment in addition to its Gauss-Newton steps, in steps


class DirectStage(TrackingStage):
    """Refinement of a hypothesis by all residuals together; the effort is the number of steps per level.

    The coarse levels alone are wrong by centimetres at times. One or two steps on the finest level remove most of it,
    so the stage also runs with fewer steps if the time is short.
    """

    name = skipped_name = "direct"

    def efforts(self, problem: TrackingProblem, hypothesis: Hypothesis) -> Sequence[int]:
        """Return the configured number of Gauss-Newton steps per level, half and a quarter of it."""
        return [max(1, round(share * problem.config.iterations)) for share in EFFORT_SHARES]

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work of alignment on all levels, and of the matches in it."""
        all_steps, units = problem.config.iterations, problem.alignment_units(0)
        n_matches = 0 if problem.matches is None else len(problem.matches.points)
        matches = n_matches * all_steps * problem.n_levels * effort / all_steps
        if effort == all_steps:
            return StageCost(("direct", units), counted=(("matches", matches),))
        share = (_FIXED_STEPS + effort) / (_FIXED_STEPS + all_steps)
        return StageCost(("direct steps", share * units), counted=(("matches", matches),))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        """Align the frame to the keyframes of the hypothesis, with the matches of the last proposal from features."""
        alignment = align(
            problem.prepared.levels,
            hypothesis.references,
            hypothesis.T_world_camera,
            problem.config.model_copy(update={"iterations": effort}),
            photometric=True,
            finest=0,
            gate=problem.config.sensor.max_depth_difference,
            features=problem.matches,
            camera=problem.prepared.frame.camera,
            blur=_BLUR_SHARE * problem.config.sensor.exposure * problem.prepared.twist,
        )
        return hypothesis.refined(alignment)
