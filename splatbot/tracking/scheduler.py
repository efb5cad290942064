"""Scheduler of the tracking stages: the one place that decides which stages run within the time of a frame.

The anytime contract: a stage that does not fit the remaining time is not started. A frame that leaves time for the
initial stages alone still gets a pose.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from splatbot.tracking.budget import CONSTANTS as COSTS
from splatbot.tracking.budget import Budget, CostModel
from splatbot.tracking.health import verdict_of
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis, measure_hypothesis, select_best
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.nearby_keyframes import pose_distance
from splatbot.tracking.prepare import PreparedFrame
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage, Work
from splatbot.tracking.stages import StageSet


class StageScheduler:
    """Runs the stages of one frame, and charges their work to the frame's budget.

    Args:
        problem: the frame and the keyframes.
        stages: stages of the tracker.
        costs: durations of recent runs. If None, the fixed table replaces the clock.
    """

    def __init__(self, problem: TrackingProblem, stages: StageSet, costs: CostModel | None) -> None:
        quantile = COSTS.lost_quantile if problem.is_lost else COSTS.deadline_quantile
        self.budget = Budget(problem.config.budget_ms, costs, problem.prepared.started, quantile)
        self._problem = problem
        self._stages = stages
        camera = problem.prepared.frame.camera
        self.budget.count("prepare", camera.width * camera.height)

    def best_hypothesis(self, prediction: Prediction) -> ScoredHypothesis:
        """Return the best pose that the stages find from a prediction within the remaining time."""
        problem, stages = self._problem, self._stages.proposals
        problem.begin(prediction)
        start, proposals = self._start(), dict[str, Hypothesis]()
        needed = (stage for stage in stages if stage.is_needed(problem))  # depends on the stages before it
        for stage, effort in self._affordable(needed, start):
            hypothesis = stage.run(problem, start, effort)
            if hypothesis is not None:
                proposals[hypothesis.stage] = hypothesis  # replaces an earlier one of the same name
        hypotheses = self._refine([start, *proposals.values()])
        best = self._score(hypotheses)
        again = [stage for stage in stages if stage.is_needed_again(problem, best)]
        found = [
            stage.run(problem, best.hypothesis, effort) for stage, effort in self._affordable(again, best.hypothesis)
        ]
        for hypothesis in filter(None, found):
            chosen = self._choose_effort(self._stages.refinement, hypothesis, len(hypotheses) + 1)
            hypotheses.append(self._refine_one(hypothesis, *chosen))
        if any(found):
            best = self._score(hypotheses)
        if len(found) < len(again):
            best = best.degraded("another pose may explain the frame better: no time was left for it")
        if not best.hypothesis.is_refined:
            best = best.degraded("not aligned on fine levels: no time was left for them")
        return best

    def align_again(self, prepared: PreparedFrame, pose: ScoredHypothesis) -> ScoredHypothesis:
        """Align a pose to the same frame after it has been rectified by another velocity, if time remains."""
        problem, stage = self._problem, self._stages.refinement
        effort, cost = self._choose_effort(stage, pose.hypothesis, 1)
        if effort is None:
            self.budget.skip("shutter")
            return pose
        problem.replace_images(prepared, pose.T_world_camera)
        with self._charged(stage, cost):
            hypothesis = stage.run(problem, pose.hypothesis, effort) or pose.hypothesis
        return self._score([hypothesis])

    def _start(self) -> Hypothesis:
        """Run the initial stages one after the other, and check the pose that they lead to."""
        problem = self._problem
        for stage in self._stages.initial:
            with self._charged(stage, stage.cost(problem, problem.start, 1)):
                problem.start = stage.run(problem, problem.start, 1) or problem.start
        problem.is_uncertain = problem.is_lost or self._moves_fast() or not self._explains(problem.start)
        return problem.start

    def _affordable(
        self, stages: Iterable[TrackingStage], hypothesis: Hypothesis
    ) -> Iterator[tuple[TrackingStage, int]]:
        """Yield the stages that fit the remaining time, with their effort; stages that do not fit are skipped.

        The caller runs a stage, and nothing else, before it takes the next one: its time is charged to the stage.
        """
        for stage in stages:
            for _ in range(stage.repetitions(self._problem)):
                effort, cost = self._choose_effort(stage, hypothesis)
                if effort is None:
                    self.budget.skip(stage.skipped_name)
                    break
                with self._charged(stage, cost):
                    yield stage, effort

    def _refine(self, proposals: list[Hypothesis]) -> list[Hypothesis]:
        """Refine the proposals, the start hypothesis first, as long as the scoring of all of them still fits."""
        refined: list[Hypothesis] = []
        for proposal in proposals:
            scorings = len(refined) + 1
            effort, cost = self._choose_effort(self._stages.refinement, proposal, scorings)
            if effort is not None or not refined or self.budget.fits(*[self._problem.scoring_work] * scorings):
                refined.append(self._refine_one(proposal, effort, cost))
        return refined

    def _refine_one(self, hypothesis: Hypothesis, effort: int | None, cost: StageCost) -> Hypothesis:
        """Refine a hypothesis with an effort; if it is None, keep the hypothesis unrefined."""
        stage, problem = self._stages.refinement, self._problem
        if effort is None:
            self.budget.skip(stage.skipped_name)
            return hypothesis
        if effort < stage.efforts(problem, hypothesis)[0]:
            self.budget.skip(f"{stage.skipped_name} steps")
        with self._charged(stage, cost):
            return stage.run(problem, hypothesis, effort) or hypothesis

    def _score(self, hypotheses: list[Hypothesis]) -> ScoredHypothesis:
        """Score all hypotheses and return the best."""
        kind, units = self._problem.scoring_work
        with self.budget.run(kind, units * len(hypotheses)):
            return select_best(self._problem.prepared, hypotheses, self._problem.config)

    def _choose_effort(
        self, stage: TrackingStage, hypothesis: Hypothesis, scorings: int = 0
    ) -> tuple[int | None, StageCost]:
        """Return the largest effort that fits with its work, or None with the work of the smallest effort."""
        reserve: list[Work] = [self._problem.scoring_work] * (stage.scorings + scorings)
        if stage.refinements:
            refinement = self._stages.refinement
            effort = refinement.efforts(self._problem, hypothesis)[0]
            measured = refinement.cost(self._problem, hypothesis, effort).measured
            reserve += [measured] * stage.refinements if measured is not None else []
        for effort in stage.efforts(self._problem, hypothesis):
            cost = stage.cost(self._problem, hypothesis, effort)
            if stage.is_mandatory(self._problem) or self.budget.fits(*cost.work, *reserve):
                return effort, cost
        return None, cost

    @contextmanager
    def _charged(self, stage: TrackingStage, cost: StageCost) -> Iterator[None]:
        """Charge the work of the stage that runs inside the block, and measure its time."""
        if cost.measured is None:
            yield
        else:
            with self.budget.run(*cost.measured, under=stage.name):
                yield
        for work in cost.counted:
            self.budget.count(*work)

    def _moves_fast(self) -> bool:
        """Return True if the predicted motion since the last known pose calls for features."""
        config = self._problem.config
        moved, turned = pose_distance(self._problem.prediction.T_world_camera, self._problem.T_last)
        return moved > config.features_motion or turned > config.features_rotation

    def _explains(self, start: Hypothesis) -> bool:
        """Return True if the health of the start hypothesis is "ok"."""
        problem = self._problem
        with self.budget.run(*problem.scoring_work):
            health = measure_hypothesis(problem.prepared, start, problem.config)
        return verdict_of(health, start.alignment.information, None, problem.config)[0] == "ok"
