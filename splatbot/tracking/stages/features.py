"""Stages that detect keypoints and match them with keyframes, near their predicted pixels or in the whole image."""

from __future__ import annotations

from collections.abc import Sequence

from splatbot.tracking.features import Expectation, Features, detect, match_pose
from splatbot.tracking.health import is_explained
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis
from splatbot.tracking.nearby_keyframes import TrackedKeyframe
from splatbot.tracking.stage import EFFORT_SHARES, Array, StageCost, TrackingProblem, TrackingStage, Work

_EXPECTED_MATCHES = 0.5  # share of the keypoints of a frame that match one keyframe, for the estimate of the cost


class KeypointStage(TrackingStage):
    """Detection of the frame's keypoints; the effort is their number.

    The stage starts only if the matching also fits the remaining time. Keypoints of an earlier pass are reused.
    """

    name = skipped_name = "features"
    refinements, scorings = 1, 1

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the start is uncertain, or features are configured for every frame."""
        return problem.is_uncertain or problem.config.features == "always"

    def efforts(self, problem: TrackingProblem, hypothesis: Hypothesis) -> Sequence[int]:
        """Return the configured number of keypoints, half and a quarter of it."""
        if problem.features is not None:
            return (len(problem.features),)
        return [round(share * problem.config.n_features) for share in EFFORT_SHARES]

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work of detection and estimate that of the matching and of the matches in the refinement."""
        n_known = sum(len(keyframe.features) for keyframe in problem.keyframes) / len(problem.keyframes)
        n_keyframes = min(problem.config.match_keyframes + 2, len(problem.keyframes))
        n_steps = problem.config.iterations * problem.n_levels
        matching: Work = ("match near", effort * n_known * n_keyframes)
        matches: Work = ("matches", _EXPECTED_MATCHES * effort * n_keyframes * n_steps)
        measured = ("detect", float(effort)) if problem.features is None else None
        return StageCost(measured, follow_up=(matching, matches))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> None:
        """Detect the keypoints for the stages that follow."""
        problem.keypoints_ready = True
        if problem.features is None:
            frame, depth = problem.prepared.frame, problem.prepared.depth
            problem.features = detect(frame.rgb, depth, frame.camera, effort, frame.mask)


class LocalMatchingStage(TrackingStage):
    """Pose from features matched near their predicted pixels."""

    name = skipped_name = "features"

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the frame has keypoints and the camera is not lost."""
        return problem.keypoints_ready and not problem.is_lost

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True: the detection has reserved the time."""
        return True

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work: pairs of keypoints of the frame and of the keyframes."""
        return StageCost(("match near", _n_pairs(problem, keyframes_to_match(problem, hypothesis))))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis | None:
        """Match features within ``match_radius`` of their pixels at the pose of the hypothesis."""
        camera = problem.prepared.frame.camera
        expected = Expectation(hypothesis.T_world_camera, problem.config.match_radius * camera.width)
        views = _views(keyframes_to_match(problem, hypothesis))
        problem.matches = match_pose(problem.detected_features, views, camera, expected)
        return None if problem.matches is None else problem.hypothesis(self.name, problem.matches.T_world_camera)


class GlobalMatchingStage(TrackingStage):
    """Pose from features matched in the whole image; the effort is the number of keyframes."""

    name, skipped_name = "features", "features anywhere"
    refinements, scorings = 2, 2

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if local matching found too few matches."""
        if problem.is_lost or not problem.keypoints_ready:
            return False
        return problem.matches is None or len(problem.matches.points) < problem.config.min_local_matches

    def is_needed_again(self, problem: TrackingProblem, best: ScoredHypothesis) -> bool:
        """Return True if the best pose does not explain the frame and features were matched only locally."""
        return problem.matches is not None and not problem.searched_all and not is_explained(best.health)

    def efforts(self, problem: TrackingProblem, hypothesis: Hypothesis) -> Sequence[int]:
        """Return the numbers of keyframes, from all that are matched down to one."""
        return range(len(keyframes_to_match(problem, hypothesis)), 0, -1)

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work: pairs of keypoints of the frame and of the keyframes."""
        keyframes = keyframes_to_match(problem, hypothesis, effort)
        return StageCost(("match all", _n_pairs(problem, keyframes)))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis | None:
        """Match all features of the frame with all features of the keyframes."""
        problem.searched_all = True
        views = _views(keyframes_to_match(problem, hypothesis, effort))
        found = match_pose(problem.detected_features, views, problem.prepared.frame.camera)
        if found is None:
            return None
        problem.matches = found
        return problem.hypothesis(self.name, found.T_world_camera)


def keyframes_to_match(problem: TrackingProblem, hypothesis: Hypothesis, n: int | None = None) -> list[TrackedKeyframe]:
    """Return the keyframes nearest to a hypothesis, the latest and the first, in the order of their insertion.

    Args:
        problem: the frame and the keyframes.
        hypothesis: expected pose of the frame.
        n: number of keyframes. The first, the latest and the farthest are left out, in this order. If None, all are
            returned.
    """
    nearby = problem.keyframe_order(hypothesis)[: problem.config.match_keyframes]
    indices = list(dict.fromkeys([*nearby, len(problem.keyframes) - 1, 0]))[:n]
    return [problem.keyframes[k] for k in sorted(indices)]


def _views(keyframes: Sequence[TrackedKeyframe]) -> list[tuple[Features, Array]]:
    return [(keyframe.features, keyframe.reference.T_world_camera) for keyframe in keyframes]


def _n_pairs(problem: TrackingProblem, keyframes: Sequence[TrackedKeyframe]) -> float:
    return float(len(problem.detected_features) * sum(len(keyframe.features) for keyframe in keyframes))
