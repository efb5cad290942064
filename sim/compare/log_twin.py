"""Sim-to-real: a recorded log against the twin that is built from its map."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.metrics import without_nan
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.recorded import ArmRecord, BaseInMap, base_in_map, pose_gap, read_arm
from splatbot.sim.compare.replay import Replay, find_knots, replay
from splatbot.sim.compare.views import SeenView, Surroundings, TwinViews, ViewAgreement, surroundings
from splatbot.sim.twin import Twin
from splatbot.spacing import evenly_spaced
from splatbot.workspace import Workspace, find_workspace, fit_workspace

KIND = "sim-to-real"
_SHOWN = 3  # frames whose images are kept

OnProgress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class LogComparison:
    """Comparison of a log with its twin.

    Args:
        log, map: their names.
        robot: the twin's arm.
        frames: number of frames of the log.
        poses: description of the source of the camera poses.
        base: of the arm in the map.
        support: height of the support plane over the base [m] and its RMS error [m]. If None, there is no such plane.
        views: one for each compared frame.
        shown: images of a few frames, by frame.
        replay: of the arm's motion. If None, the log has no motion, or the comparison was interrupted.
        notes: limits of validity.
        interrupted: whether the user stopped the comparison; the results until then are kept.
    """

    log: str
    map: str
    robot: str
    frames: int
    poses: str
    base: BaseInMap
    support: tuple[float, float] | None
    views: tuple[ViewAgreement, ...]
    shown: Mapping[int, SeenView]
    replay: Replay | None
    notes: tuple[str, ...]
    interrupted: bool

    def summary(self) -> dict[str, Any]:
        """Return means over all frames and over the held-out ones; an empty mean is undefined (None)."""
        names = [name for name in asdict(self.views[0]) if name not in ("index", "held_out")] if self.views else []
        parts = {"all": self.views, "held_out": [view for view in self.views if view.held_out]}
        found: dict[str, Any] = {
            part: {"frames": len(views), **{name: _mean([getattr(view, name) for view in views]) for name in names}}
            for part, views in parts.items()
        }
        residuals = self.base.residuals
        found["base_residual_m"] = float(np.sqrt(np.mean(residuals[:, 0] ** 2))) if len(residuals) else None
        found["base_median_m"] = float(np.median(residuals[:, 0])) if len(residuals) else None
        found["base_residual_rad"] = float(np.sqrt(np.mean(residuals[:, 1] ** 2))) if len(residuals) else None
        if self.replay is not None and self.replay.errors:
            away = np.array([(error.position_m, error.angle_rad) for error in self.replay.errors])
            found["replay_mean_m"], found["replay_mean_rad"] = away.mean(axis=0).tolist()
            found["replay_most_m"], found["replay_most_rad"] = away.max(axis=0).tolist()
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as values for JSON, without images."""
        base = {
            "T_world_base": self.base.T_world_base.tolist(),
            "source": self.base.source,
            "left_out": list(self.base.left_out),
        }
        return without_nan(
            {
                "kind": KIND,
                "log": self.log,
                "map": self.map,
                "robot": self.robot,
                "frames": self.frames,
                "poses": self.poses,
                "base": base,
                "support": None if self.support is None else {"height_m": self.support[0], "rms_m": self.support[1]},
                "summary": self.summary(),
                "views": [asdict(view) for view in self.views],
                "replay": None if self.replay is None else self.replay.to_dict(),
                "notes": list(self.notes),
                "interrupted": self.interrupted,
            }
        )


def compare_log(
    log: Log,
    run: RunFolder,
    robot: RobotModel,
    *,
    frames: int = 0,
    on_progress: OnProgress = lambda step, share: None,
) -> LogComparison:
    """Compare a log with the twin of its map: images at recorded poses, and a replay of the arm's motion.

    The camera poses come from the arm: tool poses and mount, or joints and mount. Without them they are the tracked
    ones, and the base is that of the log's scene.yaml or fitted to the map. Ctrl-C ends the comparison early and keeps
    the results so far.

    Args:
        log: the recording, with the masks of the run.
        run: the run that mapped it.
        robot: the twin's arm by its manufacturer. The scene with its calibration gives the joint offsets.
        frames: number of evenly spaced frames to compare; 0 for all.
        on_progress: called with the current step and the completed fraction.

    Raises:
        InputError: log and run have no frame in common.
        FormatError: a file of the run or of the log is damaged.
        LogError: a frame cannot be read.
    """
    record, tracked = read_arm(log.uri, run.path), run.load_poses()
    robot = robot_in_scene(robot, record.workspace)
    model = GaussianModel.load(run.map)
    stamps = _stamps(log, run)
    known = sorted(index for index in stamps if index < len(log))
    if not known or not tracked:
        raise InputError(
            f"has no tracked frame in common with {log.name}.", file=run.path, hint="give the run that mapped this log"
        )
    by_arm = {i: T for i in known if (T := record.camera_at(stamps[i], robot)) is not None}
    place = find_workspace(run.path) or record.workspace
    base = base_in_map(by_arm, tracked, record.source) if by_arm else _base_without_arm(place, model)
    poses = by_arm or {i: np.asarray(inverse(base.T_world_base) @ T) for i, T in tracked.items() if i < len(log)}
    around = surroundings(model, run.map, base.T_world_base, robot, place.support_plane)
    gaps = {i: pose_gap(base.T_world_base @ T, tracked[i]) for i, T in poses.items() if i in tracked}
    views = _LogViews(log, poses, gaps, {row.index for row in run.load_frames() if row.held_out})
    notes = [] if around.support is not None else ["no level plane within the arm's reach: there is no support plane"]
    done: Replay | None = None
    interrupted = False
    try:
        twin = TwinViews(around)
        notes += twin.world.notes
        views.compare_all(twin, _spread(sorted(poses), frames), on_progress)
        on_progress("the arm's motion", 0.0)
        done = _replay(record, [stamps.get(i, np.nan) for i in range(len(log))], around, robot)
        on_progress("the arm's motion", 1.0)
    except KeyboardInterrupt:
        interrupted = True
    return LogComparison(
        log=log.name,
        map=run.path.resolve().name,
        robot=robot.name,
        frames=len(log),
        poses=record.source if by_arm else "tracked: the log does not record the arm's poses",
        base=base,
        support=None if around.support is None else (around.support.offset, around.support.error),
        views=tuple(views.views),
        shown=views.shown,
        replay=done,
        notes=tuple(notes),
        interrupted=interrupted,
    )


@dataclass
class _LogViews:
    """Frames of a log with the twin's images, as far as they were compared.

    Args:
        log: with the frames.
        poses: T_base_camera (4, 4) by frame.
        gaps: differences [m, rad] to the tracked poses.
        held_out: frames that were kept out of the map.
    """

    log: Log
    poses: Mapping[int, Array]
    gaps: Mapping[int, tuple[float, float]]
    held_out: set[int]
    views: list[ViewAgreement] = field(default_factory=list)
    shown: dict[int, SeenView] = field(default_factory=dict)

    def compare_all(self, twin: TwinViews, chosen: Sequence[int], on_progress: OnProgress) -> None:
        keep = set(_spread(chosen, _SHOWN))
        for k, index in enumerate(chosen):
            view, seen = twin.compare(
                self.log[index], self.poses[index], held_out=index in self.held_out, gap=self.gaps.get(index)
            )
            self.views.append(view)
            if index in keep:
                self.shown[index] = seen
            on_progress("frames", (k + 1) / len(chosen))


def _replay(record: ArmRecord, stamps: Sequence[float], around: Surroundings, robot: RobotModel) -> Replay | None:
    knots = find_knots(record, stamps, robot)
    return None if knots is None else replay(knots, Twin(around.scene(robot.name), robot=robot))


def _base_without_arm(place: Workspace, model: GaussianModel) -> BaseInMap:
    if place.T_world_base is not None:
        T, source = place.T_world_base, "scene.yaml"
    else:
        proposed = fit_workspace(model).T_world_base
        assert proposed is not None
        T, source = proposed, "fitted to the map: the log does not record the arm's poses"
    return BaseInMap(T, np.zeros((0, 2)), (), (), source)


def _stamps(log: Log, run: RunFolder) -> dict[int, float]:
    """Return the stamps [s] of the frames that the run read, by their position in the log."""
    return {row.index: row.stamp for row in run.load_frames() if row.stamp is not None}


def _spread(items: Sequence[int], count: int) -> list[int]:
    """Return ``count`` evenly spaced items with both ends, or all items for 0."""
    return evenly_spaced(items, count) if count > 0 else list(items)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
