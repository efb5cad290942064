"""The tracking stages, in the order in which the scheduler runs them. A new stage is one line in the list below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splatbot.tracking.stage import TrackingStage
from splatbot.tracking.stages.direct import DirectStage
from splatbot.tracking.stages.features import GlobalMatchingStage, KeypointStage, LocalMatchingStage
from splatbot.tracking.stages.geometric import GeometricStage
from splatbot.tracking.stages.gicp import GicpStage
from splatbot.tracking.stages.predict import PredictStage
from splatbot.tracking.stages.relocalize import PlaceRecognitionStage, RelocalizationStage

INITIAL_STAGES: Sequence[type[TrackingStage]] = (PredictStage, GeometricStage)
"""Stages that lead to the start hypothesis; each begins with the hypothesis of the previous one."""

PROPOSAL_STAGES: Sequence[type[TrackingStage]] = (
    KeypointStage,
    LocalMatchingStage,
    GlobalMatchingStage,
    PlaceRecognitionStage,
    RelocalizationStage,
    GicpStage,
)
"""Stages that propose further hypotheses from the start hypothesis."""

REFINEMENT_STAGE: type[TrackingStage] = DirectStage
"""Stage that refines each hypothesis before it is scored."""


@dataclass(frozen=True, eq=False)
class StageSet:
    """Stages of one tracker.

    Args:
        initial: stages that lead to the start hypothesis.
        proposals: stages that propose further hypotheses.
        refinement: stage that refines each hypothesis.
    """

    initial: tuple[TrackingStage, ...]
    proposals: tuple[TrackingStage, ...]
    refinement: TrackingStage

    @classmethod
    def create(cls) -> StageSet:
        """Create the stages in the lists of this module."""
        initial, proposals = (tuple(kind() for kind in kinds) for kinds in (INITIAL_STAGES, PROPOSAL_STAGES))
        return cls(initial, proposals, REFINEMENT_STAGE())
