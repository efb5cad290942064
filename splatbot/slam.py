"""RGB-D Gaussian SLAM, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.mapping.executor import Executor, InlineExecutor, ThreadExecutor
from splatbot.mapping.extrinsics import MeasuredPose
from splatbot.mapping.further_camera import FurtherCamera, MapState, make_camera
from splatbot.mapping.joint_motion import JointMotionMonitor
from splatbot.mapping.keyframe_choice import FrameQuality
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import GraphLocation, Observation
from splatbot.mapping.refine import Stop, never
from splatbot.tracking.health import Verdict
from splatbot.tracking.motion_filter import mean_twist
from splatbot.tracking.prepare import MIN_DISPLACEMENT, PreparedFrame, displacement, prepare
from splatbot.tracking.tracker import PoseEstimate, Tracker
from splatbot.trajectory import Trajectory

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame.

    Args:
        T_world_camera: (4, 4), world = first camera; None when lost.
        verdict: "ok", "degraded" (tracked, with ``reasons`` to doubt it) or "lost" (the map did not change).
        stage: the tracking stage that estimated the pose.
        stage_ms: milliseconds by stage.
        keyframe: whether the frame became a keyframe.
        gaussians: number of Gaussians afterwards.
        skipped: tracking stages that did not fit the time budget.
        covariance: (6, 6) of the pose, see :attr:`splatbot.tracking.estimate.PoseEstimate.covariance`; None when lost.
        camera_name: name of the camera; empty for the first one.
        anchor: number of the first camera's keyframe that a pose of another camera moves with. If None, the pose moves
            with the keyframe at its time.
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
    camera_name: str = ""
    anchor: int | None = None


class Slam:
    """Tracks and maps a stream; ``results`` holds one entry per processed frame.

    By default everything runs in the calling thread in a fixed order: the same frames give the same map, bit for bit.
    With ``config.mapping.threaded`` a second thread maps while the caller's tracks; :meth:`close` or :meth:`finish`
    ends it.

    The first camera defines the world; its frames have no ``camera_name``. Frames of the cameras in ``config.cameras``
    go into the same map, see :mod:`splatbot.mapping.further_camera`.

    Args:
        config: If None, the defaults apply.
    """

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or Config()
        self.results: list[FrameResult] = []
        self._tracker = Tracker(self.config.tracking)
        self._mapper = Mapper(self.config)
        self._location = GraphLocation()
        self._quality = FrameQuality()
        self._joint_motion = JointMotionMonitor(self.config.mapping.still_joint_speed)
        self._image_sizes: dict[str, tuple[int, int]] = {}
        self._further_cameras = self._make_further_cameras()
        self._localization_only = False
        self._first: PreparedFrame | None = None
        """The first frame, until the velocity of the camera during it is known."""

    def process(self, frame: Frame, *, hold_out: bool = False) -> FrameResult:
        """Track a frame and, unless ``hold_out``, map it; a frame that cannot be tracked does not raise.

        A frame that is held out before the map has a keyframe is lost: there is no world to localize it in.

        Raises:
            InputError: The image size differs from that of earlier frames of the camera, or the camera is unknown; the
                map is unchanged.
        """
        clock = StageClock()
        prepared = clock.time("prepare", self._prepare, frame)
        self._apply_loop_closure()
        prepared, estimate = clock.time("tracking", self._track, prepared, hold_out)
        observation = self._observation(prepared, estimate, hold_out)
        keyframe = self._mapper.should_insert(observation)
        with self._location_restored_on_error():
            if keyframe:
                self._submit(observation)
            else:
                self._mapper.observe(observation)
            self._executor.run()
        return self._record(frame, estimate, keyframe, clock)

    def _submit(self, observation: Observation) -> None:
        """Queue a keyframe; one of the first camera becomes the location of the next frame in the pose graph."""
        location = self._mapper.submit(observation)
        if not observation.camera_name:
            self._location = location

    @contextmanager
    def _location_restored_on_error(self) -> Iterator[None]:
        """Restore the location after an error, which removes the keyframe from the map."""
        location = self._location
        try:
            yield
        except Exception:
            self._location = location
            raise

    def finish(self, stop: Stop = never) -> None:
        """Close the last loop and run the final refinement at the end of a stream, or until ``stop`` returns True."""
        self.close_loops()
        if self._localization_only:
            self._executor.close()
        else:
            self._executor.finish(stop)

    @property
    def iterations_left(self) -> int:
        """Number of iterations that :meth:`finish` runs: the pending ones and the final refinement."""
        if self._localization_only:
            return 0
        return self._mapper.pending_iterations + self.config.mapping.final_iterations

    def localise_only(self, config: Config | None = None) -> None:
        """Localize all further frames in the map, which does not change; the next frame may be anywhere in it.

        ``results`` starts again; the world frame remains that of the map.

        Args:
            config: configuration whose sensor and further cameras replace those of the map. If None, these remain.

        Raises:
            InputError: There is no map yet.
        """
        if not self._mapper.keyframes:
            raise InputError("the map has no keyframes.", field="map", hint="map a log first")
        self.close_loops()
        with self._executor.paused():
            self._mapper.freeze()
        self._localization_only = True
        self.config = config or self.config
        self._tracker.config = self.config.tracking
        self._image_sizes = {}
        self._further_cameras = self._make_further_cameras()
        self.results = []
        self._tracker.forget()

    def close_loops(self) -> None:
        """Apply a pending loop closure to the map, the poses estimated so far and the tracker.

        :meth:`process` does so for each frame. A stream that ends without :meth:`finish` needs one more call.
        """
        with self._executor.paused():
            correction = self._mapper.close_loops()
        if not correction:
            return
        self._executor.run()
        number, results, still = -1, [], np.eye(4)
        for result in self.results:
            number += result.keyframe and not result.camera_name
            if result.T_world_camera is not None:
                T_new_old = correction.get(number if result.anchor is None else result.anchor, still)
                result = replace(result, T_world_camera=T_new_old @ result.T_world_camera)
            results.append(result)
        self.results = results
        if number in correction:
            self._tracker.move(correction[number])
        for camera in self._further_cameras.values():
            camera.move(correction.get(number if camera.anchor is None else camera.anchor, still))

    def close(self) -> None:
        """End the mapping thread, if there is one, once all submitted keyframes are in the map."""
        self._executor.close()

    def paused(self) -> AbstractContextManager[None]:
        """Return a context in which the map does not change and all submitted keyframes are in it."""
        return self._executor.paused()

    @property
    def memory(self) -> dict[str, int]:
        """Memory in use [bytes].

        Keys: "gaussians_bytes" (with their bookkeeping), "optimiser_bytes", "keyframe_images_bytes" and
        "keyframe_tracking_bytes" (features, sampled pixels).
        """
        return self._mapper.memory

    @property
    def loop_counts(self) -> dict[str, int]:
        """Numbers of loop closures that were accepted ("closed") and refused ("rejected")."""
        return self._mapper.loop_counts

    @property
    def skipped_gradients(self) -> int:
        """Number of Gaussian updates that refinement skipped because the gradient was not finite."""
        return self._mapper.skipped_gradients

    @property
    def keyframes(self) -> Sequence[Keyframe]:
        """Keyframes of all cameras."""
        return self._mapper.keyframes

    @property
    def further_cameras(self) -> Mapping[str, FurtherCamera]:
        """Cameras other than the first one, by name."""
        return self._further_cameras

    @property
    def trajectory(self) -> Trajectory:
        """Current estimates of the poses of all tracked frames of the first camera."""
        return self.trajectory_of("")

    def trajectory_of(self, camera_name: str) -> Trajectory:
        """Return the current estimates of the poses of all tracked frames of a camera."""
        own = [r for r in self.results if r.camera_name == camera_name]
        poses = [(r.stamp, r.T_world_camera) for r in own if r.T_world_camera is not None]
        stamps = np.array([stamp for stamp, _ in poses], dtype=np.float64)
        return Trajectory(stamps, np.array([T for _, T in poses], dtype=np.float64).reshape(-1, 4, 4))

    def snapshot(self) -> Snapshot:
        """Return an immutable copy of the current map."""
        return self._executor.snapshot()

    @cached_property
    def _executor(self) -> Executor:
        return ThreadExecutor(self._mapper) if self.config.mapping.threaded else InlineExecutor(self._mapper)

    def _prepare(self, frame: Frame) -> PreparedFrame:
        """Check the camera and the image size of a frame and prepare it for tracking."""
        where, name = frame.source or f"frame {frame.index}", frame.camera_name
        if name and name not in self._further_cameras:
            hint = f"the further cameras are {', '.join(self._further_cameras) or 'none'}: describe it in `cameras`"
            raise InputError(f"is {name!r:.40}.", file=where, field="camera_name", hint=hint)
        size = frame.camera.width, frame.camera.height
        known = self._image_sizes.setdefault(name, size)
        if size != known:
            raise InputError(
                f"is {size[0]} x {size[1]}, earlier frames are {known[0]} x {known[1]}.",
                file=where,
                field="image size",
                hint="map recordings of different sizes separately",
            )
        if name:
            return self._further_cameras[name].prepare(frame, self.config.of_camera(name), self._map_state(frame.stamp))
        return prepare(frame, self.config.tracking, self._tracker.expected_twist(frame.stamp))

    def _apply_loop_closure(self) -> None:
        if self._mapper.has_loop:
            self.close_loops()

    def _track(self, prepared: PreparedFrame, hold_out: bool) -> tuple[PreparedFrame, PoseEstimate]:
        """Return the pose of a frame and the images that it belongs to, which tracking may have rectified."""
        if prepared.frame.camera_name:
            return self._track_further(prepared)
        keyframes = self._mapper.first_keyframes
        if keyframes:
            self._tracker.variance_scale = self._mapper.inconsistency
            estimate = self._tracker.track(prepared, keyframes)
            first = self._rectified_first(estimate, prepared.frame.stamp)
            if first is not None:
                self._start_again(first)
                return self._track(self._prepare(prepared.recorded), hold_out)
            return estimate.prepared or prepared, estimate
        if hold_out:
            return prepared, PoseEstimate(np.eye(4), "lost", ("held out before the map has begun",), "start")
        self._first = prepared
        return prepared, self._tracker.start(prepared)

    def _track_further(self, prepared: PreparedFrame) -> tuple[PreparedFrame, PoseEstimate]:
        """Return the pose of a frame of a further camera."""
        frame = prepared.frame
        camera, config = self._further_cameras[frame.camera_name], self.config.of_camera(frame.camera_name)
        estimate = camera.track(prepared, config, self._map_state(frame.stamp))
        return estimate.prepared or prepared, estimate

    def _map_state(self, stamp: float) -> MapState:
        """Return the map and the first camera at a time [s], for the further cameras."""
        pose = self._tracker.pose_at(stamp)
        return MapState(
            keyframes=self._mapper.keyframes,
            variance_scale=self._mapper.inconsistency,
            first=None if pose is None else MeasuredPose(*pose),
            first_twist=self._tracker.expected_twist(stamp),
        )

    def _make_further_cameras(self) -> dict[str, FurtherCamera]:
        cameras = self.config.cameras.items()
        return {name: make_camera(camera, self.config.of_camera(name)) for name, camera in cameras}

    def _rectified_first(self, estimate: PoseEstimate, stamp: float) -> PreparedFrame | None:
        """Return the first frame rectified by its velocity, if the second one reveals that the camera moved during it.

        The first frame is rectified as if at rest. Its rows, and depth of another instant, then contradict all frames
        that come back to its view.
        """
        first, self._first = self._first, None
        if first is None or estimate.verdict == "lost":
            return None
        twist = mean_twist(estimate.T_world_camera, stamp - first.frame.stamp)
        if displacement(first, twist, self.config.sensor) < MIN_DISPLACEMENT:
            return None
        return prepare(first.recorded, self.config.tracking, twist)

    def _start_again(self, first: PreparedFrame) -> None:
        """Replace the map and the motion by those of the first frame alone; versions of the map go on."""
        self._executor.close()
        del self._executor
        version, self._mapper = self._mapper.version, Mapper(self.config)
        self._mapper.version = version
        self._tracker, self._quality = Tracker(self.config.tracking), FrameQuality()
        self._further_cameras = self._make_further_cameras()
        self.results = [replace(r, keyframe=False) if r.camera_name else r for r in self.results]
        self._location = GraphLocation()
        self._location = self._mapper.submit(self._observation(first, self._tracker.start(first), hold_out=False))
        self._executor.run()

    def _observation(self, prepared: PreparedFrame, estimate: PoseEstimate, hold_out: bool) -> Observation:
        """Collect a tracked frame for the mapper, and note whether the robot moves."""
        if prepared.frame.camera_name:
            return self._further_observation(prepared, estimate, hold_out)
        self._mapper.set_robot_moving(self._joint_motion.update(prepared.frame.stamp, prepared.frame.joints))
        if estimate.verdict != "lost" and not hold_out:
            self._location = self._mapper.locate(estimate.T_world_camera, self._location)
        features = self._tracker.keypoints(prepared, estimate)
        observation = Observation(
            prepared, estimate.T_world_camera, features, self._location, estimate.verdict, held_out=hold_out
        )
        return replace(observation, is_poor=self._quality.is_poor(observation))

    def _further_observation(self, prepared: PreparedFrame, estimate: PoseEstimate, hold_out: bool) -> Observation:
        """Collect a frame of a further camera, which moves with a keyframe of the first camera."""
        camera = self._further_cameras[prepared.frame.camera_name]
        anchor = camera.anchor if camera.anchor is not None else self._location.keyframe
        return Observation(
            prepared,
            estimate.T_world_camera,
            camera.keypoints(prepared, estimate),
            GraphLocation(anchor),
            estimate.verdict,
            held_out=hold_out,
        )

    def _record(self, frame: Frame, estimate: PoseEstimate, keyframe: bool, clock: StageClock) -> FrameResult:
        """Append the result of a frame, and report the time outside the stages to the tracker's budget."""
        lost = estimate.verdict == "lost"
        mapping_ms = clock.since("tracking")
        result = FrameResult(
            index=frame.index,
            stamp=frame.stamp,
            T_world_camera=None if lost else estimate.T_world_camera,
            verdict=estimate.verdict,
            reasons=estimate.reasons,
            stage=estimate.stage,
            stage_ms={"prepare": clock.ms["prepare"]} | estimate.stage_ms | {"mapping": mapping_ms},
            keyframe=keyframe,
            gaussians=self._mapper.size,
            skipped=estimate.skipped,
            covariance=None if lost else estimate.covariance,
            camera_name=frame.camera_name,
            anchor=self._further_cameras[frame.camera_name].anchor if frame.camera_name else None,
        )
        self.results.append(result)
        if estimate.stage_ms and not frame.camera_name:
            stages = clock.ms["prepare"] + sum(estimate.stage_ms.values())
            if not self.config.mapping.threaded:  # with a thread, the submission is all that tracking waits for
                stages += mapping_ms
            self._tracker.record_overhead(clock.total_ms - stages)
        return result


class StageClock:
    """Wall-clock times of the stages of one frame [ms]."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self._start = time.perf_counter()
        self._ends: dict[str, float] = {}

    def time(self, stage: str, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call a function and record its duration as that of a stage."""
        start = time.perf_counter()
        result = function(*args, **kwargs)
        self._ends[stage] = time.perf_counter()
        self.ms[stage] = 1e3 * (self._ends[stage] - start)
        return result

    def since(self, stage: str) -> float:
        """Return the time since the end of a stage [ms]."""
        return 1e3 * (time.perf_counter() - self._ends[stage])

    @property
    def total_ms(self) -> float:
        """Time since the frame began [ms]."""
        return 1e3 * (time.perf_counter() - self._start)
