"""Write a tracking stage that proposes the last pose, for a camera that stops abruptly, and track a log with it."""

from splatbot import Slam, open_log
from splatbot.tracking import stages
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage


class StandstillStage(TrackingStage):
    """Proposes that the camera has not moved; the direct stage then refines the hypothesis."""

    name = skipped_name = "standstill"
    refinements, scorings = 2, 1  # work that must still fit into the time budget afterwards

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the geometric stage alone does not explain the frame."""
        return problem.is_uncertain

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Return the work of a run: 0.1 ms, because no image is processed."""
        return StageCost((self.name, 0.1))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        """Propose the last known pose."""
        return problem.hypothesis(self.name, problem.T_last)


# In the package this is one line in splatbot/tracking/stages/__init__.py.
stages.PROPOSAL_STAGES = (*stages.PROPOSAL_STAGES, StandstillStage)

slam = Slam()
for frame in open_log("synthetic:tabletop?trajectory=arm_stops&frames=8&rate=5&width=160&height=120"):
    result = slam.process(frame)
    cost_ms = result.stage_ms.get("standstill", 0.0)
    print(f"frame {frame.index}: {result.verdict} by {result.stage}, standstill {cost_ms:.1f} ms")
slam.close()
