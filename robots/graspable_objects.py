"""Graspable objects in a map: their segmentation, observer positions, and free-space evidence from depth."""

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
    """A map and the evidence of its recording.

    Args:
        state: without Gaussians that more frames saw through than supported.
        observers: (N, 3) observer position of each Gaussian [m, world], NaN if unknown. If None, no position is known.
        views: the recording's depth, subsampled.
        notes: the checks that were skipped, and why.
    """

    state: Snapshot
    observers: Array | None = None
    views: tuple[DepthView, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class GraspableObjects:
    """The objects in a map, as commands and the service grasp them."""

    measured: MeasuredMap
    scene: SegmentedMap

    def sampler(self, robot: RobotKinematics, **options: Any) -> GraspSampler:
        """Return the sampler of their grasps; ``options`` as in :class:`splatbot.grasping.sampler.GraspSampler`."""
        return GraspSampler(self.scene, robot, observers=self.measured.observers, views=self.measured.views, **options)

    def told(self, result: GraspResult) -> GraspResult:
        """Return the result with notes on the skipped checks."""
        return replace(result, notes=(*self.measured.notes, *result.notes))


def run_of(path: Path) -> RunFolder | None:
    """Return the run that a folder belongs to, or None for a file or another folder."""
    run = RunFolder(path)
    return run if run.frames.is_file() else None


def measured_map(state: Snapshot, run: RunFolder | None) -> MeasuredMap:
    """Load a map and remove flying pixels at edges, as far as its recording is available.

    Args:
        state: of the map.
        run: run that made it. If None, the checks that need it are skipped and noted.

    Raises:
        FormatError: the run's folder is damaged.
    """
    if run is None:
        return MeasuredMap(state, notes=("free-space evidence was not checked: the map belongs to no run folder.",))
    notes: tuple[str, ...] = ()
    views: tuple[DepthView, ...] = ()
    try:
        views = subsampled_views(run, reopen_log(run))
    except SplatbotError as error:
        name = f"{Path(error.file).name}: " if error.file else ""  # clients must not learn the folder
        why = f"the run's log cannot be read: {name}{error.message}"
        notes = (f"free-space evidence was not checked: {why}",)
    model = _solid(state.model, views)
    return MeasuredMap(replace(state, model=model), observers(run, model), views, notes)


def things_of(
    measured: MeasuredMap, T_world_base: ArrayLike, workspace: Workspace | None, *, as_known: bool
) -> GraspableObjects:
    """Segment the objects in a map.

    Args:
        measured: the map.
        T_world_base: (4, 4), a frame whose z is up.
        workspace: workspace of the map, if known.
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
    """Return the map without Gaussians that more views saw through than supported; the whole map without views."""
    if not views:
        return model
    return model.select(torch.from_numpy(~gather_evidence(model, views).seen_through).nonzero()[:, 0])
