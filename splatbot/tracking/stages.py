"""The stages on one frame, within its budget."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.tracking.align import SoftPrior, align
from splatbot.tracking.budget import Budget
from splatbot.tracking.features import Expectation, FeaturePose, Features, detect, match_pose
from splatbot.tracking.gicp import GicpStage
from splatbot.tracking.health import is_explained, verdict_of
from splatbot.tracking.hypothesis import Candidate, ScoredHypothesis, judge, score
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.nearby_keyframes import TrackedKeyframe, nearest, order_by_distance, pose_distance
from splatbot.tracking.prepare import PreparedFrame
from splatbot.tracking.relocalization import PlaceSearch

Array = NDArray[np.float64]
Work = tuple[str, float]

_FEWER = (1.0, 0.5, 0.25)  # shares of keypoints, and of steps of alignment: the largest that there is time for
_BEFORE_STEPS = 3  # what an alignment costs beside its steps, in steps


class TrackingStages:
    """Runs the stages on a frame, from one prediction or another.

    Args:
        features: keypoints of the frame, once they have been looked for.
    """

    def __init__(
        self,
        config: TrackingConfig,
        prepared: PreparedFrame,
        keyframes: Sequence[TrackedKeyframe],
        budget: Budget,
        wide: GicpStage,
        search: PlaceSearch | None,
    ) -> None:
        self.config = config
        self.features: Features | None = None
        self._prepared = prepared
        self._keyframes = keyframes
        self._budget = budget
        self._wide = wide
        self._search = search  # given while lost
        self._looked_anywhere = search is not None

    def run(self, prediction: Prediction, T_before: Array) -> ScoredHypothesis:
        """The best pose from a prediction; ``T_before`` is where the camera was last."""
        start = self._geometric(prediction)
        starts, matched = [start], None
        doubtful = self._is_doubtful(start, prediction.T_world_camera, T_before)
        if doubtful or self.config.features == "always":
            matched = self._match(start.T_world_camera)
            if matched is not None:
                starts.append(self._start("features", matched.T_world_camera, start))
        if doubtful and matched is None and self.config.gicp == "needed":
            starts += self._register(start)
        candidates: list[Candidate] = []
        for begun in starts:
            steps = self._steps_in_time(matched, len(candidates) + 1)
            if begun is start or steps or self._budget.fits(*[self._health_work] * (len(candidates) + 1)):
                candidates.append(self._direct(begun, matched, steps))
        found = self._judge(candidates)
        if matched is not None and not self._looked_anywhere and not is_explained(found.health):
            matched = self._match_anywhere(found.T_world_camera)
            if matched is not None:
                begun = self._start("features", matched.T_world_camera, start)
                steps = self._steps_in_time(matched, len(candidates) + 1)
                candidates.append(self._direct(begun, matched, steps))
                found = self._judge(candidates)
            elif not self._looked_anywhere:
                found = found.doubted("another pose may explain the frame better: no time was left for it")
        if not found.candidate.stage.endswith("+direct"):
            found = found.doubted("not aligned on fine levels: no time was left for them")
        return found

    def _judge(self, candidates: Sequence[Candidate]) -> ScoredHypothesis:
        with self._budget.run("health", self._health_units * len(candidates)):
            return judge(self._prepared, candidates, self.config)

    def _geometric(self, prediction: Prediction) -> Candidate:
        """Projective point-to-plane alignment on the coarse levels, held to the prediction where it sees nothing."""
        finest = min(1, len(self._prepared.levels) - 1)
        with self._budget.run("geometric", self._steps(finest)):
            views = self._nearest(prediction.T_world_camera)
            found = align(
                self._prepared.levels,
                [view.reference for view in views],
                prediction.T_world_camera,
                self.config,
                photometric=False,
                finest=finest,
                gate=2 * self.config.sensor.max_depth_difference,
                prior=SoftPrior(
                    prediction.T_world_camera, np.asarray(np.linalg.inv(prediction.covariance), dtype=np.float64)
                ),
            )
        return Candidate("geometric", found, views)

    def _direct(self, start: Candidate, matched: FeaturePose | None, iterations: int) -> Candidate:
        """Photometric, depth and feature residuals together, down to the finest level, in so many steps on each.

        Where the coarse levels alone have led is centimetres off at times; a step or two take out most of it.
        """
        if iterations < self.config.iterations:
            self._budget.skip("direct steps" if iterations else "direct")
        if not iterations:
            return start
        work, of_matches = self._direct_work(matched, iterations)
        with self._budget.run(*work, under="direct"):
            found = align(
                self._prepared.levels,
                start.references,
                start.T_world_camera,
                self.config.model_copy(update={"iterations": iterations}),
                photometric=True,
                finest=0,
                gate=self.config.sensor.max_depth_difference,
                features=matched,
                camera=self._prepared.frame.camera,
            )
        if matched is not None:
            self._budget.count(*of_matches)
        return Candidate(f"{start.stage}+direct", found, start.views)

    def _steps_in_time(self, matched: FeaturePose | None, judged: int) -> int:
        """Of direct alignment on each level: all, fewer or none, with time to judge so many candidates after it."""
        ends = [self._health_work] * judged
        for share in _FEWER:
            iterations = max(1, round(share * self.config.iterations))
            if self._budget.fits(*self._direct_work(matched, iterations), *ends):
                return iterations
        return 0

    def _is_doubtful(self, start: Candidate, T_predicted: Array, T_before: Array) -> bool:
        """Whether the geometric stage may have been led astray: lost, fast, or not explained by where it led."""
        if self._search is not None:
            return True
        moved, turned = pose_distance(T_predicted, T_before)
        if moved > self.config.features_motion or turned > self.config.features_rotation:
            return True
        with self._budget.run("health", self._health_units):
            health = score(self._prepared, start, self.config)
        return verdict_of(health, start.found.information, None, self.config)[0] != "ok"

    def _match(self, T_expected: Array) -> FeaturePose | None:
        """Pose from features, with as many keypoints as there is time for."""
        n = self._keypoints()
        if n is None:
            self._budget.skip("features")
            return None
        if self.features is None:
            frame = self._prepared.frame
            with self._budget.run("detect", n, under="features"):
                self.features = detect(frame.rgb, self._prepared.depth, frame.camera, n, frame.mask)
        if self._search is not None:
            return self._search.find(self.features, self._keyframes, self._prepared.frame.camera, self._budget)
        return self._match_near(self.features, T_expected)

    def _match_near(self, features: Features, T_expected: Array) -> FeaturePose | None:
        """Match with keyframes near to where features should be; anywhere, if too few are there."""
        views, units = self._views_to_match(features, T_expected)
        camera = self._prepared.frame.camera
        with self._budget.run("match near", units, under="features"):
            near = match_pose(features, views, camera, Expectation(T_expected, self.config.match_radius * camera.width))
        if near is not None and len(near.points) >= self.config.min_local_matches:
            return near
        return self._match_anywhere(T_expected) or near

    def _match_anywhere(self, T_expected: Array) -> FeaturePose | None:
        """Match with the same keyframes wherever in the image, with fewer if there is no time for all."""
        if self.features is None:
            return None
        ends = (*self._direct_work(None) * 2, self._health_work, self._health_work)
        for left_out in range(self.config.match_keyframes + 2):
            views, units = self._views_to_match(self.features, T_expected, left_out)
            if self._budget.fits(("match all", units), *ends):
                break
        else:
            self._budget.skip("features anywhere")
            return None
        self._looked_anywhere = True
        with self._budget.run("match all", units, under="features"):
            return match_pose(self.features, views, self._prepared.frame.camera)

    def _views_to_match(
        self, features: Features, T_expected: Array, left_out: int = 0
    ) -> tuple[list[tuple[Features, Array]], int]:
        """The nearest keyframes, the latest and the first, with their poses; how many pairs of keypoints there are.

        So many are ``left_out``: of those that are not nearest, then the farthest.
        """
        near = order_by_distance(self._keyframes, T_expected)[: self.config.match_keyframes]
        chosen = list(dict.fromkeys([*near, len(self._keyframes) - 1, 0]))
        chosen = sorted(chosen[: max(1, len(chosen) - left_out)])
        views = [(self._keyframes[k].features, self._keyframes[k].reference.T_world_camera) for k in chosen]
        return views, len(features) * sum(len(known) for known, _ in views)

    def _keypoints(self) -> int | None:
        """How many keypoints there is time to find and match, with an alignment to them to follow."""
        known = sum(len(view.features) for view in self._keyframes) / len(self._keyframes)
        views = min(self.config.match_keyframes + 2, len(self._keyframes))
        ends = (*self._direct_work(None), self._health_work)
        for share in _FEWER:
            n = round(share * self.config.n_features)
            if self.features is not None:
                n = len(self.features)
            work: list[Work] = [("match near", n * known * views), ("matches", 0.5 * n * views * self._n_steps)]
            if self.features is None:
                work.append(("detect", n))
            if self._budget.fits(*work, *ends):
                return n
        return None

    def _register(self, start: Candidate) -> list[Candidate]:
        """Poses by registration with the nearest keyframe, if there is time."""
        if not self._budget.fits(("wide", self.config.gicp_points), *self._direct_work(None) * 2, self._health_work):
            self._budget.skip("wide")
            return []
        with self._budget.run("wide", self.config.gicp_points):
            T = self._wide.register(self._prepared, start.views[0], start.T_world_camera)
        return [] if T is None else [self._start("wide", T, start)]

    def _start(self, stage: str, T_world_camera: Array, like: Candidate) -> Candidate:
        return Candidate(stage, like.found.at(T_world_camera), self._nearest(T_world_camera))

    def _nearest(self, T_world_camera: Array) -> list[TrackedKeyframe]:
        return nearest(self._keyframes, T_world_camera, self.config.reference_keyframes)

    @property
    def _n_steps(self) -> int:
        return self.config.iterations * len(self._prepared.levels)

    def _steps(self, finest: int) -> float:
        """Points times references, levels and steps of an alignment."""
        references = min(self.config.reference_keyframes, len(self._keyframes))
        return self.config.n_pixels * references * self.config.iterations * (len(self._prepared.levels) - finest)

    def _direct_work(self, matched: FeaturePose | None, iterations: int | None = None) -> tuple[Work, Work]:
        """Of the direct stage, with all its steps or so many on each level."""
        whole = self.config.iterations
        steps = whole if iterations is None else iterations
        matches = 0 if matched is None else len(matched.points) * self._n_steps * steps / whole
        if steps == whole:
            return ("direct", self._steps(0)), ("matches", matches)
        share = (_BEFORE_STEPS + steps) / (_BEFORE_STEPS + whole)
        return ("direct steps", share * self._steps(0)), ("matches", matches)

    @property
    def _health_units(self) -> float:
        return float(self.config.n_pixels * min(self.config.reference_keyframes, len(self._keyframes)))

    @property
    def _health_work(self) -> Work:
        return ("health", self._health_units)
