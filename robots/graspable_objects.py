"""Graspable objects of a map, with the viewpoints of its Gaussians and their visibility in depth images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike

from splatbot.collision import RobotSpheres
from splatbot.collision.visibility import DepthView
from splatbot.errors import SplatbotError
from splatbot.gaussians import Snapshot
from splatbot.grasping.measured import CONSTANTS as MEASURED
from splatbot.grasping.measured import RawDepth
from splatbot.grasping.object_list import ListedObject, list_objects
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.structure import find_structures
from splatbot.grasping.types import GraspResult
from splatbot.protocols import Array, RobotKinematics
from splatbot.results.folder import RunFolder
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.results.margin import AuditedError
from splatbot.results.objects import segment_workspace, unseen_through
from splatbot.results.observers import observers
from splatbot.results.plan_obstacles import support_tiles
from splatbot.results.views import raw_views, subsampled_views
from splatbot.robots.in_view import reopen_log
from splatbot.segmentation import SegmentedMap
from splatbot.workspace import Workspace


@dataclass(frozen=True, eq=False)
class MeasuredMap:
    """A map with the measurements of its recording.

    Args:
        state: the map without Gaussians that more frames see through than see.
        observers: (N, 3) viewpoint of each Gaussian [m, world], NaN if unknown. If None, all are unknown.
        views: thinned depth images of the recording.
        raw: the same without the filters of mapping. If None, it is not known.
        notes: omitted checks with reasons.
    """

    state: Snapshot
    observers: Array | None = None
    views: tuple[DepthView, ...] = ()
    raw: RawDepth | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class GraspableObjects:
    """Segmented objects of a map, from which commands and service sample grasps."""

    measured: MeasuredMap
    scene: SegmentedMap

    def sampler(self, robot: RobotKinematics, **options: Any) -> GraspSampler:
        """Create a grasp sampler; for ``options`` see :class:`splatbot.grasping.sampler.GraspSampler`."""
        measured = self.measured
        return GraspSampler(
            self.scene, robot, observers=measured.observers, views=measured.views, raw=measured.raw, **options
        )

    def listed(self, robot: RobotKinematics, *, margin: float, plane: ArrayLike | None) -> tuple[ListedObject, ...]:
        """List the objects, with reach among the obstacles of plans.

        Args:
            robot: the arm.
            margin: clearance [m] that the links before the hand keep.
            plane: (4,) support plane of the scene.yaml; if None, only the map is an obstacle.
        """
        arm = RobotSpheres(robot, T_world_base=self.scene.T_world_base)
        tiles = None if plane is None else support_tiles(plane, arm, robot.home, margin=margin)
        return list_objects(self.scene, robot, margin=margin, solids=tiles)

    def error_around(self, error: AuditedError) -> float:
        """Return the audited error of a map around its objects [m], 0 without objects."""
        centers = [item.center for item in self.scene.objects]
        return error.in_region(centers).quantile(MARGIN.confidence) if centers else 0.0

    def with_notes(self, result: GraspResult) -> GraspResult:
        """Add the notes of the map to a result."""
        return replace(result, notes=(*self.measured.notes, *result.notes))


def run_of(path: Path) -> RunFolder | None:
    """Return the run of a folder, or None for a file or a folder of another kind."""
    run = RunFolder(path)
    return run if run.frames.is_file() else None


def measured_map(state: Snapshot, run: RunFolder | None) -> MeasuredMap:
    """Remove flying pixels from a map by the visibility in its recording, if that is available.

    Args:
        state: the map.
        run: run that made the map. If None, visibility is not checked, which a note states.

    Raises:
        FormatError: the run's folder is damaged.
    """
    if run is None:
        return MeasuredMap(state, notes=("Visibility was not checked, because the map is in no run's folder.",))
    notes: tuple[str, ...] = ()
    views: tuple[DepthView, ...] = ()
    raw = None
    try:
        log = reopen_log(run)
        views, sensor = subsampled_views(run, log), run.load_config().sensor
        raw = RawDepth(raw_views(run, log, MEASURED.frames)[1], sensor.sigma_depth_floor, sensor.sigma_depth_quad)
    except SplatbotError as error:
        name = f"{Path(error.file).name}: " if error.file else ""  # without the private path of the folder
        reason = f"the run's log cannot be read: {name}{error.message}"
        notes = (f"Visibility was not checked, because {reason}",)
    model = state.model.select(torch.from_numpy(unseen_through(state.model, views)))
    return MeasuredMap(replace(state, model=model), observers(run, model), views, raw, notes)


def segment_objects(
    measured: MeasuredMap, T_world_base: ArrayLike, workspace: Workspace | None, *, as_known: bool
) -> GraspableObjects:
    """Segment the objects of a map, and find which of them are structure.

    Args:
        measured: the map.
        T_world_base: (4, 4) pose of the base, with z up [m].
        workspace: description of the scene in addition to the map.
        as_known: True if the base is that of the workspace, so that its box and plane apply.

    Raises:
        InputError: the box contains no Gaussians.
    """
    scene = segment_workspace(measured.state, T_world_base, workspace, as_known=as_known, observers=measured.observers)
    return GraspableObjects(measured, replace(scene, structures=find_structures(scene, measured.views)))
