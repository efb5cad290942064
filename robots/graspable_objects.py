"""What a robot can grasp in a map: the things in it, where they were seen from, and what depth saw through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike

from splatbot.collision.visibility import DepthView, gather_evidence
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import GraspResult
from splatbot.protocols import Array, RobotKinematics
from splatbot.results.folder import RunFolder
from splatbot.results.observers import observers
from splatbot.results.views import subsampled_views
from splatbot.robots.in_view import reopen_log
from splatbot.segmentation import SegmentedMap, segment
from splatbot.workspace import Workspace


@dataclass(frozen=True, eq=False)
class MeasuredMap:
    """A map and what the recording that it was made of says of it.

    Args:
        state: without what more frames saw through than saw.
        observers: (N, 3) where each Gaussian was seen from [m, world], NaN where that is not known; None: nowhere is.
        views: the recording's depth, subsampled.
        notes: what was not asked, and why.
    """

    state: Snapshot
    observers: Array | None = None
    views: tuple[DepthView, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class GraspableObjects:
    """The things in a map, as commands and service alike ask for grasps of them."""

    measured: MeasuredMap
    scene: SegmentedMap

    def sampler(self, robot: RobotKinematics, **options: Any) -> GraspSampler:
        """Of grasps of them; ``options`` as of :class:`splatbot.grasping.sampler.GraspSampler`."""
        return GraspSampler(self.scene, robot, observers=self.measured.observers, views=self.measured.views, **options)

    def told(self, result: GraspResult) -> GraspResult:
        """With what was not asked."""
        return replace(result, notes=(*self.measured.notes, *result.notes))


def run_of(path: Path) -> RunFolder | None:
    """The run that a folder is of; None: it is of none, or a file."""
    run = RunFolder(path)
    return run if run.frames.is_file() else None


def measured_map(state: Snapshot, run: RunFolder | None) -> MeasuredMap:
    """A map but for flying pixels at edges, as far as its recording can be asked.

    Args:
        state: of the map.
        run: that made it; None: none is known, which is noted.

    Raises:
        FormatError: the run's folder is damaged.
    """
    if run is None:
        return MeasuredMap(state, notes=("What depth saw through was not asked, for the map is of no run's folder.",))
    notes: tuple[str, ...] = ()
    views: tuple[DepthView, ...] = ()
    try:
        views = subsampled_views(run, reopen_log(run))
    except SplatbotError as error:
        name = f"{Path(error.file).name}: " if error.file else ""  # the folder is nobody's business
        why = f"the run's log cannot be read: {name}{error.message}"
        notes = (f"What depth saw through was not asked, for {why}",)
    model = _solid(state.model, views)
    return MeasuredMap(replace(state, model=model), observers(run, model), views, notes)


def things_of(
    measured: MeasuredMap, T_world_base: ArrayLike, workspace: Workspace | None, *, as_known: bool
) -> GraspableObjects:
    """The things in a map.

    Args:
        measured: the map.
        T_world_base: (4, 4), a frame whose z is up.
        workspace: what is known beside the map.
        as_known: the base is the workspace's, and so are its box and plane.

    Raises:
        InputError: nothing of the map is in the box.
    """
    own = workspace if as_known else None
    scene = segment(
        measured.state,
        T_world_base,
        box=own.box if own is not None else None,
        plane=own.support_plane if own is not None else None,
        names=workspace.objects if workspace is not None else (),
        observers=measured.observers,
    )
    return GraspableObjects(measured, scene)


def _solid(model: GaussianModel, views: tuple[DepthView, ...]) -> GaussianModel:
    """Without what more views saw through than saw; all of it where there is no view."""
    if not views:
        return model
    return model.select(torch.from_numpy(~gather_evidence(model, views).seen_through).nonzero()[:, 0])
