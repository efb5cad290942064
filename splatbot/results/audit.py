"""Audit of a run's map against the depth images of its own log."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField
from splatbot.collision.audit import CONSTANTS as AUDIT
from splatbot.collision.audit import Hole, SurfaceAudit, audit_surfaces
from splatbot.collision.confirmed import CONSTANTS as CONFIRMED
from splatbot.collision.confirmed import find_confirmed
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.results.metrics import without_nan
from splatbot.results.objects import segment_workspace, unseen_through
from splatbot.results.observers import observers
from splatbot.results.views import raw_views, subsampled_views
from splatbot.workspace import find_workspace, fit_workspace


@dataclass(frozen=True, eq=False)
class ObjectAudit:
    """Audit of the surface points nearest to one object of the map.

    Args:
        name: name of the object in ``scene.yaml``, or "object" or "support" and its number, or "rest".
        points: number of confirmed points.
        missed_share: share of them that is farther than 1 cm from the field.
        worst: largest distance [m].
    """

    name: str
    points: int
    missed_share: float
    worst: float


@dataclass(frozen=True, eq=False)
class RunAudit:
    """Audit of a run.

    Args:
        audit: surfaces and free space.
        objects: the surface within the working distance, by object; empty if the map has no support plane.
        picture: (H, W, 3) uint8 colour of the frame that shows the largest hole, or of the first one.
        marks: (M, 2) pixels (column, row) of the missed points in it.
        index: its position in the log.
    """

    audit: SurfaceAudit
    objects: tuple[ObjectAudit, ...]
    picture: NDArray[np.uint8]
    marks: NDArray[np.int64]
    index: int

    def summary(self) -> dict[str, Any]:
        """Return the figures under the stable keys of ``audit.json``."""
        near = self.audit.within()
        holes = near.holes()
        return without_nan(
            {
                "points_proposed": self.audit.space.proposed,
                "points_confirmed": len(self.audit.space.surface),
                "points_free": len(self.audit.space.free),
                "working_distance_m": AUDIT.working_distance,
                "missed_distance_m": AUDIT.missed_distance,
                "missed_share": near.missed_share(),
                "surface_error_q999_m": near.quantile(0.999),
                "false_hit_share": self.audit.false_hit_share,
                "holes": [_hole(hole) for hole in holes],
                "by_distance": self._by_distance(),
                "by_object": [vars(part) for part in self.objects],
                "agreeing_views": CONFIRMED.agreeing_views,
                "passing_views": CONFIRMED.passing_views,
            }
        )

    def _by_distance(self) -> list[dict[str, Any]]:
        depth, edges = self.audit.space.depth, AUDIT.distance_edges
        rows = []
        for low, high in pairwise(edges):
            part = self.audit.select((depth > low) & (depth <= high))
            rows.append(
                {
                    "from_m": low,
                    "to_m": high,
                    "points": len(part.distance),
                    "missed_share": part.missed_share(),
                    "surface_error_q999_m": part.quantile(0.999),
                }
            )
        return rows


def audit_run(run: RunFolder, log: Log, *, n_sigma: float = 2.0) -> RunAudit:
    """Check the map of a run against the raw depth of at most 40 evenly spaced frames.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        n_sigma: surface of a Gaussian, in standard deviations.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
        InputError: no frame of the run has a pose.
    """
    indices, views = raw_views(run, log)
    if not views:
        raise InputError("has no frame with a pose.", file=run.path, field="RUN", hint="map the log again")
    sensor = run.load_config().sensor
    model = GaussianModel.load(run.map)
    space = find_confirmed(views, floor=sensor.sigma_depth_floor, quad=sensor.sigma_depth_quad)
    audit = audit_surfaces(GaussianCollisionField(model, n_sigma), space)
    near = audit.within()
    holes = near.holes()
    marked = holes[0].rows if holes else np.flatnonzero(near.missed)
    shown = int(np.bincount(near.space.view[marked]).argmax()) if len(marked) else 0
    frame = log[indices[shown]]
    marks = near.space.pixel[near.missed & (near.space.view == shown)]
    step = frame.camera.width / views[shown][1].width
    return RunAudit(
        audit, _by_object(near, model, run, log), frame.rgb, np.rint(marks * step).astype(np.int64), indices[shown]
    )


def audit_metrics(audit: RunAudit | None) -> dict[str, float | None]:
    """Return the audit's part of ``metrics.json``."""
    summary: dict[str, Any] = {} if audit is None else audit.summary()
    return {
        "surface_missed_share": summary.get("missed_share"),
        "surface_error_q999_m": summary.get("surface_error_q999_m"),
        "free_hit_share": summary.get("false_hit_share"),
    }


def _by_object(near: SurfaceAudit, model: GaussianModel, run: RunFolder, log: Log) -> tuple[ObjectAudit, ...]:
    """Divide the surface by the object of the nearest Gaussian, with the numbers of `splatbot objects`."""
    try:
        workspace = find_workspace(run.map) or fit_workspace(model)
        if workspace.T_world_base is None:
            return ()
        kept = unseen_through(model, subsampled_views(run, log))
        solid = model.select(torch.from_numpy(kept))
        scene = segment_workspace(
            solid, workspace.T_world_base, workspace, as_known=True, observers=observers(run, solid)
        )
    except InputError:  # no support plane: the map has no objects
        return ()
    of_row = np.full(len(model), -1, np.int32)
    of_row[kept] = scene.labels
    labels = np.where(near.gaussian >= 0, of_row[near.gaussian], -1)
    names = {thing.number: thing.name or f"object {thing.number}" for thing in scene.objects}
    found = []
    for label in np.unique(labels):
        distance = near.distance[labels == label]
        name = names[int(label)] if label >= 0 else "rest" if label == -1 else f"support {-2 - int(label)}"
        missed = float((distance > AUDIT.missed_distance).mean())
        found.append(ObjectAudit(name, len(distance), missed, float(distance.max())))
    return tuple(sorted(found, key=lambda part: -part.missed_share))


def _hole(hole: Hole) -> dict[str, Any]:
    return {
        "center_m": hole.center.tolist(),
        "length_m": float(hole.size[0]),
        "width_m": float(hole.size[1]) if len(hole.size) > 1 else 0.0,
        "depth_m": hole.depth,
        "points": len(hole.rows),
    }
