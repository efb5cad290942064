"""Keyframes of walls in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from splatbot.camera import Camera
from splatbot.frame import Frame
from splatbot.mapping.executor import InlineExecutor
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import Observation
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import prepare
from splatbot.tracking.reference import Reference
from tests.rgbd import CAMERA, Array, wall_frame

MakeKeyframe = Callable[..., Keyframe]


def keyframe_of(frame: Frame, T_world_camera: Array, number: int = 0) -> Keyframe:
    """Make a keyframe of a frame as it is, without features and reference pixels."""
    return Keyframe(
        number=number,
        camera=frame.camera,
        rgb=torch.from_numpy(frame.rgb),
        depth=torch.from_numpy(frame.depth),
        T_world_camera=T_world_camera,
        features=Features.none(),
        reference=Reference(T_world_camera, ()),
    )


def insert(mapper: Mapper, frame: Frame, T_world_camera: Array | None = None) -> None:
    """Insert a frame as a keyframe, in the calling thread, and refine."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    mapper.submit(Observation(prepare(frame, mapper.config.tracking), T))
    InlineExecutor(mapper).run()


def observe(mapper: Mapper, frame: Frame, T_world_camera: Array | None = None) -> None:
    """Compare the map with a frame that is no keyframe, in the calling thread."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    mapper.observe(Observation(prepare(frame, mapper.config.tracking), T))
    InlineExecutor(mapper).run()


def should_insert(mapper: Mapper, frame: Frame, T_world_camera: Array | None = None) -> bool:
    """Return whether a frame qualifies as a keyframe."""
    T = np.eye(4) if T_world_camera is None else T_world_camera
    return mapper.should_insert(Observation(prepare(frame, mapper.config.tracking), T))


@pytest.fixture
def make_keyframe() -> MakeKeyframe:
    """Return a function that makes a keyframe of the textured wall ``normal · x = distance``."""

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
