"""Write a log format, one .npz file per frame, and map a recording of it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot import Camera, Frame, Slam, open_log
from splatbot.logs.base import LogBase
from splatbot.trajectory import Trajectory


@dataclass
class NpzLog(LogBase):
    """A folder of files 0000.npz, 0001.npz, ... with rgb, depth [m] and stamp [s]."""

    folder: Path
    camera: Camera
    ground_truth: Trajectory | None = None

    def __len__(self) -> int:
        return len(list(self.folder.glob("*.npz")))

    def _decode(self, index: int) -> Frame:
        data = np.load(self.folder / f"{index:04d}.npz")
        return Frame(float(data["stamp"]), data["rgb"], data["depth"], self.camera, index)


folder = Path("recording")
folder.mkdir()
source = open_log("synthetic:tabletop?frames=5&width=160&height=120")
for frame in source:
    np.savez(folder / f"{frame.index:04d}.npz", rgb=frame.rgb, depth=frame.depth, stamp=frame.stamp)

log, slam = NpzLog(folder, source.camera), Slam()
verdicts = [slam.process(frame).verdict for frame in log]
print(f"{len(log)} frames of {folder}: {', '.join(verdicts)}; {len(slam.snapshot().model)} Gaussians")
slam.close()
