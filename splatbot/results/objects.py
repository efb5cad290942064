"""The one segmentation of a map into supports and objects, which all lists of objects number alike."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.collision.visibility import DepthView, gather_evidence
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap, segment
from splatbot.workspace import Workspace


def unseen_through(model: GaussianModel, views: Iterable[DepthView]) -> NDArray[np.int64]:
    """Return the rows of the Gaussians that are no flying pixels: views do not look through them.

    Args:
        model: the map.
        views: measured depth; without views all rows remain.
    """
    found = tuple(views)
    if not found:
        return np.arange(len(model))
    return np.flatnonzero(~gather_evidence(model, found).seen_through)


def segment_workspace(
    source: GaussianModel | Snapshot,
    T_world_base: ArrayLike,
    workspace: Workspace | None,
    *,
    as_known: bool,
    observers: Array | None,
) -> SegmentedMap:
    """Segment a map without flying pixels.

    Args:
        source: the map.
        T_world_base: (4, 4) pose of the base, with z up [m].
        workspace: description of the scene in addition to the map.
        as_known: True if the base is that of the workspace, so that its box and plane apply.
        observers: (N, 3) camera centre from which each Gaussian was observed [m, world], NaN where unknown.

    Raises:
        InputError: the box contains no Gaussians.
    """
    own = workspace if as_known else None
    return segment(
        source,
        T_world_base,
        box=own.box if own is not None else None,
        plane=own.support_plane if own is not None else None,
        names=workspace.objects if workspace is not None else (),
        observers=observers,
    )
