"""Keyframes of walls in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.features import Features
from splatbot.tracking.reference import Reference
from tests.rgbd import CAMERA, Array, wall_frame

MakeKeyframe = Callable[..., Keyframe]


def keyframe_of(frame: Frame, T_world_camera: Array, number: int = 0) -> Keyframe:
    """A keyframe of a frame as it is, without what tracking needs of it."""
    return Keyframe(
        number=number,
        camera=frame.camera,
        rgb=torch.from_numpy(frame.rgb),
        depth=torch.from_numpy(frame.depth),
        T_world_camera=T_world_camera,
        features=Features.none(),
        reference=Reference(T_world_camera, ()),
    )


@pytest.fixture
def make_keyframe() -> MakeKeyframe:
    """Builds a keyframe that looks at the textured wall ``normal · x = distance``."""

    def make(
        T_world_camera: Array | None = None,
        *,
        normal: ArrayLike = (0.0, 0.0, 1.0),
        distance: float = 1.0,
        camera: Camera = CAMERA,
        number: int = 0,
    ) -> Keyframe:
        T = np.eye(4) if T_world_camera is None else T_world_camera
        return keyframe_of(wall_frame(T, normal=normal, distance=distance, camera=camera), T, number)

    return make
