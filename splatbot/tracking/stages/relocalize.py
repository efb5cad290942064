"""Stages that relocalize a lost camera: place recognition among all keyframes, then a pose from the best of them."""

from __future__ import annotations

from splatbot.tracking.features import Features, match_pose
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.place_recognition import votes
from splatbot.tracking.stage import Array, StageCost, TrackingProblem, TrackingStage, Work

_MATCHED_KEYFRAMES = 4  # number of keyframes with the most votes that features are matched with


class PlaceRecognitionStage(TrackingStage):
    """Comparison of a lost frame with one keyframe after the other, over several frames if the time is short.

    The search begins with the latest keyframe. On the next frame it continues where it stopped.
    """

    name, skipped_name = "relocalize", "keyframes"

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the camera is lost and the frame has keypoints."""
        return problem.is_lost and problem.keypoints_ready

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True for the first keyframe: each lost frame is compared with one keyframe at least."""
        return not problem.votes

    def repetitions(self, problem: TrackingProblem) -> int:
        """Return the number of keyframes."""
        return len(problem.keyframes)

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Return the work of one comparison, and an upper bound of that of the matching that follows."""
        pairs = _MATCHED_KEYFRAMES * len(problem.detected_features) * problem.max_keyframe_features
        matching: Work = ("match all", float(pairs))
        return StageCost(("vote", 1), follow_up=(matching,))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> None:
        """Count the descriptors of the next keyframe that match the frame."""
        keyframe = problem.keyframes[problem.search.next_index(len(problem.keyframes))]
        problem.votes.append((int(votes(problem.detected_features, [keyframe])[0]), keyframe))


class RelocalizationStage(TrackingStage):
    """Pose from features matched with the keyframes of the most votes."""

    name = skipped_name = "relocalize"

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if place recognition has compared keyframes."""
        return bool(problem.votes)

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True: place recognition has reserved the time."""
        return True

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work: pairs of keypoints of the frame and of the keyframes."""
        n_known = sum(len(features) for features, _ in _best_keyframes(problem))
        return StageCost(("match all", float(len(problem.detected_features) * n_known)))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis | None:
        """Match all features of the frame with all features of the best keyframes."""
        camera = problem.prepared.frame.camera
        problem.matches = match_pose(problem.detected_features, _best_keyframes(problem), camera)
        return None if problem.matches is None else problem.hypothesis(self.name, problem.matches.T_world_camera)


def _best_keyframes(problem: TrackingProblem) -> list[tuple[Features, Array]]:
    """Return features and pose of the keyframes with the most votes; of equal ones, the first compared."""
    ranked = sorted(problem.votes, key=lambda vote: -vote[0])[:_MATCHED_KEYFRAMES]
    return [(keyframe.features, keyframe.reference.T_world_camera) for _, keyframe in ranked]
