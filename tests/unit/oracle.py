"""A stand-in for SLAM whose answers are known: poses from the reference, the map from back-projected pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import inverse, transform_points
from splatbot.mapping.further_camera import FurtherCamera
from splatbot.mapping.refine import Stop, never
from splatbot.slam import FrameResult, Slam, Verdict
from splatbot.trajectory import Trajectory


class OracleSlam(Slam):
    """Takes every pose from ``reference`` and adds the pixels of every frame, except frames listed by index.

    Args:
        reference: the poses; world = first camera, as Slam has it.
        lost, degraded: frames to report so.
        crash_at: frame at which to raise RuntimeError.
    """

    def __init__(
        self,
        reference: Trajectory,
        config: Config | None = None,
        *,
        lost: tuple[int, ...] = (),
        degraded: tuple[int, ...] = (),
        crash_at: int | None = None,
    ) -> None:
        self.config = config or Config()
        self.results: list[FrameResult] = []
        self.seen: list[tuple[int, bool]] = []
        self.finished = False
        self.loops_closed = False
        self._reference, self._lost, self._degraded, self._crash_at = reference, lost, degraded, crash_at
        self._points: list[NDArray[np.float64]] = []
        self._colors: list[NDArray[np.float64]] = []

    @property
    def further_cameras(self) -> dict[str, FurtherCamera]:
        """There is one camera."""
        return {}

    @property
    def iterations_left(self) -> int:
        """Nothing is refined."""
        return 0

    @property
    def memory(self) -> dict[str, int]:
        """Not counted."""
        return {}

    @property
    def loop_counts(self) -> dict[str, int]:
        """It has none."""
        return {"closed": 0, "rejected": 0}

    @property
    def skipped_gradients(self) -> int:
        """Zero, because this class refines nothing."""
        return 0

    def process(self, frame: Frame, *, hold_out: bool = False) -> FrameResult:
        """Return the pose of the reference; the frame's pixels enter the map unless it is held out or lost."""
        if frame.index == self._crash_at:
            raise RuntimeError("crashed on purpose")
        self.seen.append((frame.index, hold_out))
        verdict: Verdict = "ok"
        if frame.index in self._lost:
            verdict = "lost"
        elif frame.index in self._degraded:
            verdict = "degraded"
        pose = None if verdict == "lost" else self._pose(frame.stamp)
        keyframe = pose is not None and not hold_out
        if keyframe and pose is not None:
            self._add(frame, pose)
        result = FrameResult(
            index=frame.index,
            stamp=frame.stamp,
            T_world_camera=pose,
            verdict=verdict,
            reasons=() if verdict == "ok" else (f"told to be {verdict}",),
            stage="oracle",
            stage_ms={"track": 2.0, "map": 3.0 if keyframe else 0.0},
            keyframe=keyframe,
            gaussians=sum(map(len, self._points)),
            skipped=("features",) if verdict == "degraded" else (),
        )
        self.results.append(result)
        return result

    def finish(self, stop: Stop = never) -> None:
        """Record the call; this class refines nothing."""
        self.finished = True

    def close_loops(self) -> None:
        """Record the call."""
        self.loops_closed = True

    def close(self) -> None:
        """Return; this class has no threads."""

    def snapshot(self) -> Snapshot:
        """Return a small sphere for every added pixel."""
        if not self._points:
            return Snapshot(GaussianModel.empty(), 0)
        points, colors = np.concatenate(self._points), np.concatenate(self._colors)
        n = len(points)
        quats = np.zeros((n, 4))
        quats[:, 0] = 1.0
        model = GaussianModel.from_activated(
            means=points, quats=quats, scales=np.full((n, 3), 0.004), opacities=np.full(n, 0.95), colors=colors
        )
        return Snapshot(model, len(self.results), self.results[-1].stamp)

    def _pose(self, stamp: float) -> NDArray[np.float64]:
        row = int(np.argmin(np.abs(self._reference.stamps - stamp)))
        poses = self._reference.T_world_camera
        return inverse(poses[0]) @ poses[row]

    def _add(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> None:
        step = max(frame.camera.width // 160, 1)
        pick = np.zeros_like(frame.valid)
        pick[::step, ::step] = frame.valid[::step, ::step]
        self._points.append(transform_points(T_world_camera, frame.camera.backproject(frame.depth)[pick]))
        self._colors.append(frame.rgb[pick] / 255.0)
