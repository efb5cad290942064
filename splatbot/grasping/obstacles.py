"""Obstacles around a target: the map without the target and with flattened support planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.geometry import rotation_to_quat
from splatbot.grasping.attached import within
from splatbot.planning.cartesian import StraightResult
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap

_SUPPORT_STD_M = 1e-3  # standard deviation of a support's Gaussians along the normal of its plane


def around_target(scene: SegmentedMap, rows: NDArray[np.int64]) -> GaussianModel:
    """Return the map without the target's ``rows`` (M,), with the Gaussians of each support moved into its plane.

    Hundreds of Gaussians determine a support plane to less than a millimetre. A single one may reach a centimetre above
    it, which would make thin objects on a table ungraspable. Each Gaussian of a support is therefore projected onto the
    plane and flattened to a disc with a standard deviation of 1 mm along the normal.
    """
    model = scene.model.clone()
    for k, support in enumerate(scene.supports):
        own = np.flatnonzero(scene.labels == -2 - k)
        if not len(own):
            continue
        up = scene.T_world_base[:3, :3] @ support.normal
        height = torch.from_numpy(support.height(scene.points[own])).to(model.means.dtype)
        index = torch.from_numpy(own)
        normal = torch.from_numpy(up).to(model.means.dtype)
        model.means[index] -= height[:, None] * normal
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        side /= np.linalg.norm(side)
        quat = rotation_to_quat(np.stack([side, np.cross(up, side), up], axis=1))
        model.quats[index] = torch.from_numpy(quat).to(model.quats.dtype)
        widest = model.log_scales[index].sort(dim=1).values[:, 1]
        model.log_scales[index] = torch.stack(
            [widest, widest, torch.full_like(widest, float(np.log(_SUPPORT_STD_M)))], dim=1
        )
    return model.select(torch.from_numpy(rows_around(scene, rows)))


def rows_around(scene: SegmentedMap, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows (K,) of the map that remain without the target's ``rows`` (M,), in their order."""
    return np.setdiff1d(np.arange(len(scene.model)), rows)


def rows_without_strays(around: GaussianModel, spheres: Array) -> NDArray[np.int64]:
    """Return the rows (K,) of a map without its target that are not inside of the target, in their order.

    Gaussians inside of it are its own strays, which segmentation did not assign to it. They move with it.

    Args:
        around: the map without the target.
        spheres: (A, 4) spheres (x, y, z, radius) that cover the target [m, world].
    """
    return np.flatnonzero(~within(around.means.detach().double().numpy(), spheres))


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Names of the surfaces that block a line of the tool.

    Args:
        scene: the segmented map.
        rows: (K,) row in the map of each Gaussian of the field of the line. Further Gaussians of that field are regions
            where motion was observed.
    """

    scene: SegmentedMap
    rows: NDArray[np.int64]

    def name(self, gaussian: int) -> str:
        """Return the name of the surface that a Gaussian of the field belongs to."""
        if gaussian >= len(self.rows):
            return "a region where motion was observed"
        label = int(self.scene.labels[self.rows[gaussian]])
        if label >= 0:
            return f"object {label}"
        return "Gaussians without a label" if label == -1 else f"support {-2 - label}"

    def reason(self, line: StraightResult) -> str:
        """Return why a line ends early, as a clause that names the surface, its place and the part that meets it."""
        cause = line.cause
        if cause is None or cause.gaussian < 0:
            return line.reason.rstrip(".")
        where = f"at {line.share:.0%} of the line" if line.share > 0.0 else "at the start"
        return f"{where} {cause.deep_in(self.name(cause.gaussian))}"
