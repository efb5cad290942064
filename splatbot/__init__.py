"""splatbot: RGB-D streams become a map of 3D Gaussians on CPUs, and the map answers a robot's questions."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatbot.camera import Camera
    from splatbot.collision import GaussianCollisionField
    from splatbot.config import load_config
    from splatbot.errors import SplatbotError
    from splatbot.frame import Frame
    from splatbot.gaussians import GaussianModel
    from splatbot.logs import open_log
    from splatbot.planning import GaussianRRTStar
    from splatbot.rasterize import rasterization, rasterization_2dgs
    from splatbot.slam import Slam

    __version__: str

_HOME = {
    "Camera": "splatbot.camera",
    "Frame": "splatbot.frame",
    "GaussianModel": "splatbot.gaussians",
    "GaussianCollisionField": "splatbot.collision",
    "GaussianRRTStar": "splatbot.planning",
    "Slam": "splatbot.slam",
    "SplatbotError": "splatbot.errors",
    "load_config": "splatbot.config",
    "open_log": "splatbot.logs",
    "rasterization": "splatbot.rasterize",
    "rasterization_2dgs": "splatbot.rasterize",
}

__all__ = [
    "Camera",
    "Frame",
    "GaussianCollisionField",
    "GaussianModel",
    "GaussianRRTStar",
    "Slam",
    "SplatbotError",
    "load_config",
    "open_log",
    "rasterization",
    "rasterization_2dgs",
]


def __getattr__(name: str) -> Any:
    """Import public names on first use: torch alone takes seconds, and `splatbot --help` needs none of it.

    The version is that of the installed package, which pyproject.toml alone states.
    """
    if name == "__version__":
        from importlib.metadata import version

        return version("splatbot")
    if name not in _HOME:
        raise AttributeError(f"module 'splatbot' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)
