"""Interface of the tracking stages, and the problem that they solve for one frame.

A stage states its cost in units of work and proposes a pose. It does not know the time budget:
:mod:`splatbot.tracking.scheduler` decides which stages run, in which order and with which effort.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse, transform_points
from splatbot.tracking.align import Alignment
from splatbot.tracking.features import FeaturePose, Features
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.nearby_keyframes import TrackedKeyframe, nearest, order_by_distance
from splatbot.tracking.prepare import PreparedFrame, typical_depth
from splatbot.tracking.rectify import moved_pixels
from splatbot.tracking.relocalization import PlaceSearch
from splatbot.tracking.uncertainty import CalibratedView

Array = NDArray[np.float64]

Work = tuple[str, float]
"""Kind of work and its amount, in the units of the table in :mod:`splatbot.tracking.budget`."""

EFFORT_SHARES = (1.0, 0.5, 0.25)
"""Shares of the configured effort (keypoints, Gauss-Newton steps) that a stage offers, largest first."""


@dataclass(frozen=True)
class StageCost:
    """Work of one run of a stage.

    Args:
        measured: work whose time is measured. If None, the run does no work.
        counted: work inside the stage that is charged by the table in addition to the measured work.
        follow_up: estimated work of later stages without which a run is useless.
    """

    measured: Work | None
    counted: tuple[Work, ...] = ()
    follow_up: tuple[Work, ...] = ()

    @property
    def work(self) -> tuple[Work, ...]:
        """All work that must fit into the remaining time before the stage starts."""
        return (*(() if self.measured is None else (self.measured,)), *self.counted, *self.follow_up)


@dataclass(eq=False)
class TrackingProblem:
    """Pose estimation of one frame: its inputs, and the intermediate results that stages share.

    Args:
        config: settings of tracking.
        prepared: pyramid of the frame.
        keyframes: keyframes of the map.
        is_lost: True if the previous frame was lost.
        T_last: (4, 4) last known ``T_world_camera``.
        search: search for a lost camera, which continues over several frames.
        features: keypoints of the frame. If None, no stage has detected them yet.
        searched_all: True if features were matched in the whole image, or are matched with all keyframes.
        prediction: motion prior or robot prior that the current pass begins with.
        start: hypothesis of the initial stages. Proposals take its information until the direct stage refines them.
        is_uncertain: True if the start hypothesis may be wrong, so that further stages are worth their cost.
        matches: matches of the last proposal from features. If None, no features have been matched.
        keypoints_ready: True if the time for keypoints and their matching is reserved in the current pass.
        votes: number of matching descriptors and keyframe, of each keyframe that place recognition has compared.
    """

    config: TrackingConfig
    prepared: PreparedFrame
    keyframes: Sequence[TrackedKeyframe]
    is_lost: bool
    T_last: Array
    search: PlaceSearch
    features: Features | None = None
    searched_all: bool = False
    prediction: Prediction = field(init=False)
    start: Hypothesis = field(init=False)
    is_uncertain: bool = field(init=False)
    matches: FeaturePose | None = field(init=False)
    keypoints_ready: bool = field(init=False)
    votes: list[tuple[int, TrackedKeyframe]] = field(init=False)
    _orders: dict[Hypothesis, list[int]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Set ``searched_all`` for a lost camera, because relocalization compares all keyframes."""
        self.searched_all = self.searched_all or self.is_lost

    def begin(self, prediction: Prediction) -> None:
        """Begin a pass from a prediction. Keypoints of an earlier pass stay valid."""
        self.prediction = prediction
        self.start = Hypothesis("last", Alignment.unconstrained(self.T_last), [])
        self.is_uncertain = True
        self.matches = None
        self.keypoints_ready = False
        self.votes = []

    def replace_images(self, prepared: PreparedFrame, T_world_camera: Array) -> None:
        """Replace the pyramid by that of another velocity; matches move with their pixels, keypoints are discarded."""
        if self.matches is not None:
            points = transform_points(inverse(T_world_camera), self.matches.points)
            change, readout = prepared.twist - self.prepared.twist, self.config.sensor.readout
            pixels = moved_pixels(self.matches.pixels, points, prepared.frame.camera, change, readout)
            self.matches = replace(self.matches, pixels=pixels)
        self.prepared, self.features = prepared, None

    def calibrated_view(self, twist: Array) -> CalibratedView:
        """Return the frame's quantities for errors of calibration, at a velocity (6,) [m/s, rad/s] of the camera."""
        return CalibratedView(self.config.sensor, twist, typical_depth(self.prepared), self.prepared.frame.camera.fx)

    def hypothesis(self, stage: str, T_world_camera: Array) -> Hypothesis:
        """Return a hypothesis at a pose (4, 4), to be aligned to the keyframes nearest to it."""
        return Hypothesis(stage, self.start.alignment.at(T_world_camera), self.nearest(T_world_camera))

    def nearest(self, T_world_camera: Array) -> list[TrackedKeyframe]:
        """Return the keyframes nearest to a pose (4, 4) that the frame is aligned to."""
        return nearest(self.keyframes, T_world_camera, self.config.reference_keyframes)

    def keyframe_order(self, hypothesis: Hypothesis) -> list[int]:
        """Return the indices of all keyframes, those nearest to a hypothesis first."""
        if hypothesis not in self._orders:
            self._orders[hypothesis] = order_by_distance(self.keyframes, hypothesis.T_world_camera)
        return self._orders[hypothesis]

    @property
    def detected_features(self) -> Features:
        """Keypoints of the frame, for stages that run after their detection."""
        if self.features is None:
            raise RuntimeError("matching stages run after the detection of keypoints")
        return self.features

    @cached_property
    def max_keyframe_features(self) -> int:
        """Number of features of the keyframe that has the most."""
        return max(len(keyframe.features) for keyframe in self.keyframes)

    @property
    def n_levels(self) -> int:
        """Number of pyramid levels."""
        return len(self.prepared.levels)

    @property
    def n_references(self) -> int:
        """Number of keyframes that the frame is aligned to."""
        return min(self.config.reference_keyframes, len(self.keyframes))

    def alignment_units(self, finest: int) -> float:
        """Compute the work of an alignment down to a level: points times references, steps and levels."""
        return self.config.n_pixels * self.n_references * self.config.iterations * (self.n_levels - finest)

    @property
    def scoring_work(self) -> Work:
        """Work of scoring one hypothesis: points times references."""
        return "health", float(self.config.n_pixels * self.n_references)


class TrackingStage(ABC):
    """One way to find the pose of a frame.

    A new stage is one subclass in a file of its own and one line in :data:`splatbot.tracking.stages.PROPOSAL_STAGES`.

    Attributes:
        name: name in ``stage_ms`` and, for stages that propose a pose, of the hypothesis.
        skipped_name: entry of ``skipped`` if the stage does not fit the remaining time.
        refinements: number of direct refinements that must still fit after the stage.
        scorings: number of scorings that must still fit after the stage.
    """

    name: str
    skipped_name: str
    refinements: int = 0
    scorings: int = 0

    def is_needed(self, problem: TrackingProblem) -> bool:
        """Return True if the stage should run on this frame."""
        return True

    def is_needed_again(self, problem: TrackingProblem, best: ScoredHypothesis) -> bool:
        """Return True if the stage should run again from the best pose, which may be wrong."""
        return False

    def is_mandatory(self, problem: TrackingProblem) -> bool:
        """Return True if the stage starts even if it does not fit the remaining time.

        An earlier stage has reserved the time for it (:attr:`StageCost.follow_up`), or no pose exists without it.
        """
        return False

    def repetitions(self, problem: TrackingProblem) -> int:
        """Return the number of runs on this frame; each of them is started only if it fits the remaining time."""
        return 1

    def efforts(self, problem: TrackingProblem, hypothesis: Hypothesis) -> Sequence[int]:
        """Return the efforts that the stage can run with, largest first, in a unit of its own."""
        return (1,)

    @abstractmethod
    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Compute the work of a run from a hypothesis with an effort."""

    @abstractmethod
    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis | None:
        """Propose a pose from a hypothesis, or return None if the stage finds none."""
