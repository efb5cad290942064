"""RGB-D Gaussian SLAM, frame by frame."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.mapping.joint_motion import JointMotionMonitor
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.refine import Stop, never
from splatbot.mapping.worker import MappingWorker
from splatbot.tracking.health import Verdict
from splatbot.tracking.prepare import PreparedFrame, prepare
from splatbot.tracking.tracker import PoseEstimate, Tracker
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class FrameResult:
    """What became of one frame.

    Args:
        T_world_camera: (4, 4), world = first camera; None when lost.
        verdict: "ok", "degraded" (tracked, with ``reasons`` to doubt it) or "lost" (map frozen).
        stage: the stage whose pose was taken.
        stage_ms: milliseconds by stage.
        keyframe: whether the frame entered the map.
        gaussians: size of the map afterwards.
        skipped: tracking stages that there was no time for.
        covariance: (6, 6) of the pose, see :attr:`splatbot.tracking.estimate.PoseEstimate.covariance`; None when lost.
    """

    index: int
    stamp: float
    T_world_camera: NDArray[np.float64] | None
    verdict: Verdict
    reasons: tuple[str, ...] = ()
    stage: str = ""
    stage_ms: dict[str, float] = field(default_factory=dict)
    keyframe: bool = False
    gaussians: int = 0
    skipped: tuple[str, ...] = ()
    covariance: NDArray[np.float64] | None = None


class Slam:
    """Tracks and maps a stream; ``results`` holds one entry per processed frame.

    Everything runs in the calling thread in a fixed order, so the same frames give the same map, bit for bit; unless
    ``config.mapping.threaded``: then a thread maps while the caller's tracks; :meth:`close` or :meth:`finish` ends it.

    Args:
        config: None takes the defaults.
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.results: list[FrameResult] = []
        self._tracker = Tracker(self.config.tracking)
        mapper = Mapper(self.config)
        self._mapper = MappingWorker(mapper) if self.config.mapping.threaded else mapper
        self._looked = -math.inf
        self._size: tuple[int, int] | None = None
        self._growing = True
        self._motion = JointMotionMonitor(self.config.mapping.still_joint_speed)

    def process(self, frame: Frame, *, hold_out: bool = False) -> FrameResult:
        """Track ``frame`` and, unless ``hold_out``, fuse it. Never raises for a frame that cannot be tracked.

        A frame held out before the map has begun is lost: there is no world yet to place it in.

        Raises:
            InputError: the frame is of another size than those before; the map is as it was.
        """
        self._check_size(frame)
        start = time.perf_counter()
        if self._mapper.has_loop:
            self.close_loops()
        prepared = prepare(frame, self.config.tracking)
        prepared_at = time.perf_counter()
        estimate = self._track(prepared, hold_out)
        tracked_at = time.perf_counter()
        if self._growing:
            self._mapper.hold(self._motion.update(frame.stamp, frame.joints))
        placed = estimate.verdict != "lost"
        keyframe = self._growing and placed and not hold_out and self._mapper.wants(prepared, estimate.T_world_camera)
        if keyframe:
            self._map(prepared, estimate)
        elif self._growing and estimate.verdict == "ok" and not hold_out and self._looks(frame.stamp):
            self._mapper.look(prepared, estimate.T_world_camera)
        stage_ms = {"prepare": 1e3 * (prepared_at - start)} | estimate.stage_ms
        stage_ms["mapping"] = 1e3 * (time.perf_counter() - tracked_at)
        result = FrameResult(
            index=frame.index,
            stamp=frame.stamp,
            T_world_camera=None if estimate.verdict == "lost" else estimate.T_world_camera,
            verdict=estimate.verdict,
            reasons=estimate.reasons,
            stage=estimate.stage,
            stage_ms=stage_ms,
            keyframe=keyframe,
            gaussians=self._mapper.size,
            skipped=estimate.skipped,
            covariance=estimate.covariance if placed else None,
        )
        self.results.append(result)
        if estimate.stage_ms:
            stages = stage_ms["prepare"] + sum(estimate.stage_ms.values())
            if not self.config.mapping.threaded:  # then tracking does not wait for more than the hand-over
                stages += stage_ms["mapping"]
            self._tracker.note_rest(1e3 * (time.perf_counter() - start) - stages)
        return result

    def finish(self, stop: Stop = never) -> None:
        """Close the last loop and spend the last refinement once the stream has ended, or until ``stop`` says so."""
        if self._growing:
            self.close_loops()
            self._mapper.finish(stop)
        else:
            self._mapper.close()

    def localise_only(self) -> None:
        """From here on frames are placed in the map as it is, which nothing changes; the next may be anywhere in it.

        ``results`` begins anew, and the world stays the map's.

        Raises:
            InputError: there is no map yet.
        """
        if not self._mapper.keyframes:
            raise InputError("the map has no keyframes.", field="map", hint="map a log first")
        self.close_loops()
        self._growing = False
        self._size = None
        self.results = []
        self._tracker.forget()

    def close_loops(self) -> None:
        """Move the map's pieces where the loops want them, and with them the poses found so far and the tracker.

        Frames that are processed do so; it is for the end of a stream that is not to be finished.
        """
        if not self._growing:
            return
        with self._mapper.paused():
            correction = self._mapper.close_loops()
        number, moved = -1, []
        for result in self.results:
            number += result.keyframe
            T, known = result.T_world_camera, correction.get(number)
            moved.append(result if T is None or known is None else replace(result, T_world_camera=known @ T))
        self.results = moved
        if number in correction:
            self._tracker.move(correction[number])

    def close(self) -> None:
        """End the mapping thread, if there is one, once what has been handed to it is in the map."""
        self._mapper.close()

    def paused(self) -> AbstractContextManager[None]:
        """A block in which nothing changes: what has been handed to a mapping thread is in the map, and it waits."""
        return self._mapper.paused()

    @property
    def memory(self) -> dict[str, int]:
        """Bytes held: "gaussians_bytes" (bookkeeping included), "optimiser_bytes", "keyframe_images_bytes" and
        "keyframe_tracking_bytes" (features, sampled pixels).
        """
        return self._mapper.memory

    @property
    def loop_counts(self) -> dict[str, int]:
        """How many places were recognised ("closed"), and how many only looked like it ("rejected")."""
        return self._mapper.loop_counts

    @property
    def skipped_gradients(self) -> int:
        """How often refinement left a Gaussian as it was because its gradient was not finite."""
        return self._mapper.skipped_gradients

    @property
    def keyframes(self) -> Sequence[Keyframe]:
        """What frames are tracked against."""
        return self._mapper.keyframes

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames that were tracked, as they are known now."""
        poses = [(r.stamp, r.T_world_camera) for r in self.results if r.T_world_camera is not None]
        stamps = np.array([stamp for stamp, _ in poses], dtype=np.float64)
        return Trajectory(stamps, np.array([T for _, T in poses], dtype=np.float64).reshape(-1, 4, 4))

    def snapshot(self) -> Snapshot:
        """The map as it is now, immutable."""
        return self._mapper.snapshot()

    def _check_size(self, frame: Frame) -> None:
        size = frame.camera.width, frame.camera.height
        self._size = self._size or size
        if size != self._size:
            raise InputError(
                f"is {size[0]} x {size[1]}, frames before are {self._size[0]} x {self._size[1]}.",
                file=frame.source or f"frame {frame.index}",
                field="image size",
                hint="map recordings of different sizes by themselves",
            )

    def _track(self, prepared: PreparedFrame, hold_out: bool) -> PoseEstimate:
        keyframes = self._mapper.keyframes
        if keyframes:
            return self._tracker.track(prepared, keyframes)
        if hold_out:
            return PoseEstimate(np.eye(4), "lost", ("held out before the map has begun",), "start")
        return self._tracker.start(prepared)

    def _looks(self, stamp: float) -> bool:
        """Whether it is time to look at a frame that is no keyframe."""
        if 0 <= stamp - self._looked < self.config.mapping.observe_interval_s:
            return False
        self._looked = stamp
        return True

    def _map(self, prepared: PreparedFrame, estimate: PoseEstimate) -> None:
        self._mapper.insert(prepared, estimate.T_world_camera, self._tracker.keypoints(prepared, estimate))
