"""Replica as NICE-SLAM rendered it: results/frame%06d.jpg, results/depth%06d.png, traj.txt, cam_params.json."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from splatbot.errors import CameraError, LogError
from splatbot.frame import Frame
from splatbot.logs.base import StampedLog
from splatbot.logs.calibration import Calibration, make_calibration, read_object
from splatbot.logs.presets import find_calibration
from splatbot.logs.rgbd import FolderLog, RgbdReader
from splatbot.trajectory import Trajectory

_RATE = 30.0  # [Hz]; the layout has no stamps


class ReplicaLog(FolderLog, StampedLog):
    """A rendered sequence; frame i has the stamp i / 30 s and the pose of line i of traj.txt.

    Raises:
        LogError: there are no frames.
        CameraError: there are no usable intrinsics.
    """

    def __init__(self, folder: str | Path, *, camera: str | Path | Calibration | None = None) -> None:
        super().__init__(folder)
        results = self.folder / "results"
        self._colors = sorted(p for p in results.glob("frame*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
        if not self._colors:
            raise LogError(
                "the log is empty: there is no frame*.jpg.", file=results, hint="render frame000000.jpg, ... there"
            )
        self.stamps = [index / _RATE for index in range(len(self._colors))]
        self._reader = RgbdReader(find_calibration(camera) if camera is not None else self._calibration())

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Poses of traj.txt, T_world_camera.

        Raises:
            LogError: a line does not hold the 16 numbers of a pose.
        """
        path = self.folder / "traj.txt"
        if not path.exists():
            return None
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
        poses = [_parse_pose(path, i, line) for i, line in enumerate(lines, 1) if line.strip()]
        return Trajectory(np.arange(len(poses)) / _RATE, np.array(poses).reshape(-1, 4, 4))

    def _decode(self, index: int) -> Frame:
        color = self._colors[index]
        depth = color.with_name(f"depth{color.stem.removeprefix('frame')}.png")
        return self._reader.read(index, self.stamps[index], color, depth)

    def _calibration(self) -> Calibration:
        places = [folder / "cam_params.json" for folder in (self.folder, self.folder.resolve().parent)]
        path = next((place for place in places if place.exists()), None)
        if path is None:
            raise CameraError(
                "the log has no intrinsics.",
                file=places[0],
                field="camera",
                hint='write {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} there or in the parent folder, '
                "or name an intrinsics.json: --camera FILE",
            )
        values = read_object(path).get("camera")
        if not isinstance(values, dict):
            raise CameraError("is missing.", file=path, field="camera", hint='write {"camera": {"w": ..., ...}}')
        return make_calibration(path, values, scale_key="scale", size_keys=("w", "h"))


def _parse_pose(path: Path, line_number: int, line: str) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != 16 or not np.isfinite(row).all():
        raise LogError(
            f"{line.strip()[:80]!r} is no pose.",
            file=path,
            field=f"line {line_number}",
            hint="write the 16 numbers of T_world_camera, row by row",
        )
    return row
