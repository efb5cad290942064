"""A served map as the scene of a twin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from splatbot.formats.ply import save_ply
from splatbot.services.store import ServedMap
from splatbot.sim.maps.placed import placed_scene
from splatbot.sim.scene import Scene, make_scene
from splatbot.workspace import NAME, Workspace


@contextmanager
def scene_of_map(
    served: ServedMap,
    T_world_base: NDArray[np.float64],
    robot: str,
    *,
    force: Sequence[str] = (),
    forbid: Sequence[str] = (),
) -> Iterator[Scene]:
    """Build the scene of the latest map version in the frame of the robot's base, valid inside the context.

    Args:
        served: the map.
        T_world_base: (4, 4).
        robot: name of the model.
        force: effects that are on in any case.
        forbid: effects that are disabled.

    Raises:
        MapNotReadyError: the map has no state yet.
        ConfigError: an effect is unknown.
    """
    known = served.workspace if served.workspace is not None else Workspace(T_world_base)
    with TemporaryDirectory() as folder:
        save_ply(served.ready.model, Path(folder) / "map.ply", bookkeeping=True)
        replace(known, T_world_base=T_world_base).save(Path(folder) / NAME)
        values = placed_scene(Path(folder)) | {"name": served.id, "robot": {"model": robot}}
        yield make_scene(values).with_effects(force=force, forbid=forbid)
