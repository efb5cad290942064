"""The page of a finished map that its report shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.trajectory import Trajectory


def page_of_map(model: GaussianModel, trajectory: Trajectory) -> str:
    """Return a self-contained page with the map and the camera's trajectory in an interactive view."""
    from splatbot.services.viewer.page import map_page

    return map_page(model, trajectory=trajectory)
