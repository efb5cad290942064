"""`synthetic:SCENE?frames=N&...`: a ray-cast scene on an exactly known path; frames are free of noise."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs.base import LogBase
from splatbot.logs.scenes import SCENES, Scene
from splatbot.trajectory import Trajectory

PREFIX = "synthetic:"
_PERIOD = 8.0  # [s] there and back along the arc: 0.5° and 8 mm per frame at the fastest


@dataclass(frozen=True)
class Options:
    """What the query of a synthetic log may set.

    Args:
        frames: how many.
        width, height: [px]; the field of view stays 62.8° across.
        arc: angle [deg] over which the camera swings about the scene.
        rate: frames per second [Hz].
    """

    frames: int = 120
    width: int = 640
    height: int = 480
    arc: float = 40.0
    rate: float = 30.0


_BOUNDS = {"frames": (1, 100_000), "width": (16, 4096), "height": (16, 4096), "arc": (0, 120), "rate": (0.1, 1000)}


class SyntheticLog(LogBase):
    """Frames of a scene, rendered when read; the same ``uri`` gives the same bits.

    Raises:
        LogError: the scene or an option is unknown, or a value is out of range.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.name, _, query = uri.removeprefix(PREFIX).partition("?")
        if self.name not in SCENES:
            raise LogError(
                f"there is no scene {self.name!r}.", file=uri, field="scene", hint=f"scenes: {', '.join(SCENES)}"
            )
        self.options = _parse(uri, query)

    @cached_property
    def camera(self) -> Camera:
        """An ideal pinhole camera."""
        f, w, h = 525.0 * self.options.width / 640.0, self.options.width, self.options.height
        return Camera(f, f, (w - 1) / 2, (h - 1) / 2, w, h)

    @cached_property
    def ground_truth(self) -> Trajectory:
        """The exact poses T_world_camera; z is up, the table's top is z = 0."""
        stamps = np.arange(len(self)) / self.options.rate
        return Trajectory(stamps, np.array([orbit(t, np.radians(self.options.arc)) for t in stamps]))

    def __len__(self) -> int:
        return self.options.frames

    @cached_property
    def _scene(self) -> Scene:
        return SCENES[self.name]()

    def _decode(self, index: int) -> Frame:
        rgb, depth = self._scene.render(self.camera, self.ground_truth.T_world_camera[index])
        return Frame(
            float(self.ground_truth.stamps[index]), rgb, depth, self.camera, index, source=f"{self.uri}#{index}"
        )


def orbit(t: float, arc: float) -> NDArray[np.float64]:
    """T_world_camera (4, 4) at time ``t`` [s]: swings over ``arc`` [rad] before the scene, bobbing."""
    azimuth = -np.pi / 2 + 0.5 * arc * np.sin(2 * np.pi * t / _PERIOD)
    radius = 0.80 + 0.06 * np.sin(2 * np.pi * t / 5.3)
    eye = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), 0.50 + 0.05 * np.sin(2 * np.pi * t / 6.7)])
    target = np.array([-0.02, 0.03 * np.sin(2 * np.pi * t / 4.1), 0.04])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def _parse(uri: str, query: str) -> Options:
    kinds = {name: type(value) for name, value in asdict(Options()).items()}
    values: dict[str, float] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in kinds:
            raise LogError("is unknown.", file=uri, field=key, hint=f"options: {', '.join(kinds)}")
        low, high = _BOUNDS[key]
        try:
            value = kinds[key](text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise LogError(f"is {text!r}.", file=uri, field=key, hint=f"give a number in {low}..{high}")
        values[key] = value
    return Options(**values)  # type: ignore[arg-type]
