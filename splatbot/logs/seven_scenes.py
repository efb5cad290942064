"""A sequence of 7-Scenes (Shotton et al. 2013): frame-000000.color.png, .depth.png and .pose.txt.

Depth is in millimetres; 0 and 65535 mark missing depth. It is not registered to colour: the images stay as published.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.logs.base import MILLIMETRES
from splatbot.logs.calibration import Calibration, read_calibration
from splatbot.logs.pairs import RATE, PairLog, numbered_files, pair_files
from splatbot.logs.poses import read_matrix, rigid_pose
from splatbot.logs.presets import find_calibration

CALIBRATION = Calibration(Camera(585.0, 585.0, 320.0, 240.0, 640, 480), MILLIMETRES, "7-Scenes")
"""Published intrinsics of both images."""


class SevenScenesLog(PairLog):
    """A sequence folder; frame number n has the stamp n / 30 s, and `frame-n.pose.txt` is its reference pose.

    Args:
        folder: of the sequence.
        camera: intrinsics that replace those of an `intrinsics.json` in the folder, else the published ones.

    Raises:
        LogError: no colour image has a depth image, or two files have one number.
        CameraError: the given intrinsics are not usable.
    """

    def __init__(self, folder: str | Path, *, camera: str | Path | Calibration | None = None) -> None:
        place = Path(folder)
        colors, depths = (numbered_files(place, rf"frame-(?P<n>\d+)\.{part}\.png") for part in ("color", "depth"))
        pairs, self.unpaired = pair_files(place, colors, depths)
        own = place / "intrinsics.json"
        if camera is not None:
            calibration = find_calibration(camera)
        else:
            calibration = read_calibration(own) if own.exists() else CALIBRATION
        super().__init__(folder, pairs, [pair.number / RATE for pair in pairs], calibration)

    def _poses(self) -> Iterable[NDArray[np.float64] | None]:
        for pair in self._pairs:
            path = pair.color.with_name(pair.color.name[: -len("color.png")] + "pose.txt")
            yield rigid_pose(read_matrix(path)) if path.exists() else None
