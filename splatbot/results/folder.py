"""The output folder of a run: configuration, trajectory, frames, metrics, map and report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write, replace_files, write_text
from splatbot.checksums import NAME as SUMS
from splatbot.checksums import check_file, read_sums, write_sums
from splatbot.config import Config, load_config
from splatbot.errors import FormatError, InputError
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel
from splatbot.layouts import check_run_folder
from splatbot.trajectory import Trajectory

_NOT_A_RUN = "give a folder that `splatbot map` wrote"


@dataclass(frozen=True)
class FrameRow:
    """One line of ``frames.jsonl``: the result of one frame of the log.

    Args:
        index: position in the log.
        stamp: time [s], or None if the frame could not be read.
        verdict: as in :class:`splatbot.slam.FrameResult`, "skipped" when the frame could not be read, or
            "dropped" when a paced run had no time for it.
        reasons: causes of a verdict other than "ok".
        stage: the tracking stage that produced the pose.
        ms: wall-clock milliseconds for tracking and mapping, without reading the file.
        stage_ms: milliseconds by stage.
        keyframe: whether the frame entered the map.
        held_out: whether the frame was kept out of the map for scoring.
        gaussians: size of the map after the frame.
        late: whether, in a paced run, the next frame arrived before this one was done.
        covariance: of the pose, as in :class:`splatbot.slam.FrameResult`: the 21 values of the upper triangle by
            rows; or None if there is no pose.
        skipped: tracking stages that were left out for lack of time.
        camera_name: name of the camera; empty for the first one.
    """

    index: int
    stamp: float | None
    verdict: Literal["ok", "degraded", "lost", "skipped", "dropped"]
    reasons: tuple[str, ...] = ()
    stage: str = ""
    ms: float = 0.0
    stage_ms: dict[str, float] = field(default_factory=dict)
    keyframe: bool = False
    held_out: bool = False
    gaussians: int = 0
    late: bool = False
    covariance: tuple[float, ...] | None = None
    skipped: tuple[str, ...] = ()
    camera_name: str = ""

    @property
    def processed(self) -> bool:
        """Return whether tracking processed the frame."""
        return self.verdict not in ("skipped", "dropped")

    @property
    def tracked(self) -> bool:
        """Return whether the frame has a pose."""
        return self.verdict in ("ok", "degraded")


class RunFolder:
    """Paths of a run's files, with reading and writing. Every file is replaced atomically."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.trajectory = self.path / "trajectory.tum"
        self.frames = self.path / "frames.jsonl"
        self.metrics = self.path / "metrics.json"
        self.map = self.path / "map.ply"
        self.mapped = self.path / "map.mapped.ply"
        self.report = self.path / "report.html"
        self.map_page = self.path / "map.html"
        self.audit = self.path / "audit.json"
        self.measured = self.path / "measured_surface.npz"
        self.is_new = False

    def trajectory_of(self, camera_name: str) -> Path:
        """Return the path of the poses of a camera: that of the first one is ``trajectory``."""
        return self.path / f"trajectory-{camera_name}.tum" if camera_name else self.trajectory

    @classmethod
    def create(cls, path: str | Path) -> RunFolder:
        """Create the folder if it does not exist; files of an earlier run stay until :meth:`save` replaces them.

        Raises:
            InputError: the folder cannot be made or written to.
        """
        folder = cls(path)
        folder.is_new = not folder.path.exists()
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
            probe = folder.path / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise InputError(
                f"cannot be written ({error.strerror}).", file=path, field="--out", hint="name another folder"
            ) from error
        return folder

    def save(
        self,
        *,
        config: Config,
        rows: Sequence[FrameRow],
        trajectories: Mapping[str, Trajectory],
        model: GaussianModel,
        metrics: Mapping[str, Any],
    ) -> None:
        """Write all files but report and audit. Older ones are deleted because they describe another map.

        The files are replaced once all are written: a full disk leaves those of the last save as they were.
        """
        rows_text = "\n".join([*(json.dumps(asdict(row)) for row in rows), ""])
        poses = {self.trajectory_of(name).name: _writer(trajectory) for name, trajectory in trajectories.items()}
        older = [path.name for path in self._further_trajectories() if path.name not in poses]
        replace_files(
            self.path,
            {
                # unobserved Gaussians must stay marked for collision checks
                self.map.name: lambda path: save_ply(model, path, bookkeeping=True),
                **poses,
                self.frames.name: write_text(rows_text),
                self.config.name: write_text(config.to_yaml()),
                self.metrics.name: write_text(_metrics_text(metrics)),
            },
            # a run that is killed from here on has no checksums
            remove=(*self._about_the_map(), self.mapped.name, *older, SUMS),
        )
        write_sums(self.path, self._files())

    def replace_map(self, model: GaussianModel) -> None:
        """Replace the map by one that was trained further; ``map.mapped.ply`` keeps the first one.

        Report, map page and audit are deleted because they describe the earlier map.
        """
        if not self.mapped.exists():
            with atomic_write(self.mapped) as kept:
                kept.write(self._require(self.map).read_bytes())
        replace_files(
            self.path,
            {self.map.name: lambda path: save_ply(model, path, bookkeeping=True)},
            remove=(*self._about_the_map(), SUMS),
        )
        write_sums(self.path, self._files())

    def remove_if_new(self) -> None:
        """Remove the folder if :meth:`create` made it and it is still empty."""
        if self.is_new and self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    def save_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write ``metrics.json``."""
        self._replace(self.metrics, _metrics_text(metrics))

    def save_audit(self, summary: Mapping[str, Any]) -> None:
        """Write ``audit.json``."""
        self._replace(self.audit, json.dumps(summary, indent=2, allow_nan=False) + "\n")

    def save_report(self, html: str) -> None:
        """Write ``report.html``."""
        self._replace(self.report, html)

    def save_map_page(self, html: str) -> None:
        """Write ``map.html``."""
        self._replace(self.map_page, html)

    def load_config(self) -> Config:
        """Load the configuration of the run; the current environment variables do not change it."""
        self._require(self.config)
        return load_config(self.config, environ={})

    def load_metrics(self) -> dict[str, Any]:
        """Load ``metrics.json``.

        Raises:
            FormatError: the file is missing or damaged.
        """
        try:
            metrics = json.loads(self._require(self.metrics).read_text(encoding="utf-8"))
        except ValueError as error:
            raise FormatError(f"is not JSON: {error}.", file=self.metrics, hint="run `splatbot map` again") from error
        if not isinstance(metrics, dict):
            raise FormatError("is not a JSON object.", file=self.metrics, hint="run `splatbot map` again")
        return metrics

    def load_frames(self) -> list[FrameRow]:
        """Load the rows of ``frames.jsonl``.

        Raises:
            FormatError: the file is missing or a line is damaged.
        """
        rows = []
        for number, line in enumerate(self._require(self.frames).read_text(encoding="utf-8").splitlines(), 1):
            try:
                values = json.loads(line)
                rows.append(FrameRow(**values | {"reasons": tuple(values["reasons"])}))
            except (ValueError, TypeError, KeyError) as error:
                raise FormatError(
                    f"is not a frame ({error}).",
                    file=self.frames,
                    field=f"line {number}",
                    hint="run `splatbot map` again",
                ) from error
        return rows

    def load_trajectory(self, camera_name: str = "") -> Trajectory:
        """Load the poses of the tracked frames of a camera, by default of the first one."""
        return Trajectory.load(self._require(self.trajectory_of(camera_name)))

    def load_trajectories(self) -> dict[str, Trajectory]:
        """Load the poses of the tracked frames of each camera by its name; the first camera has the empty name."""
        names = dict.fromkeys(["", *(row.camera_name for row in self.load_frames() if row.tracked)])
        return {name: self.load_trajectory(name) for name in names}

    def load_poses(self) -> dict[int, NDArray[np.float64]]:
        """Load T_world_camera (4, 4) of every tracked frame of all cameras, by its position in the log.

        Raises:
            FormatError: ``frames.jsonl`` and the files of poses do not match.
        """
        rows = [row for row in self.load_frames() if row.tracked]
        poses: dict[int, NDArray[np.float64]] = {}
        for name in dict.fromkeys(row.camera_name for row in rows):
            poses |= self._poses_of(name, [row for row in rows if row.camera_name == name])
        return dict(sorted(poses.items()))

    def _poses_of(self, camera_name: str, rows: Sequence[FrameRow]) -> dict[int, NDArray[np.float64]]:
        """Load the poses of the tracked frames of one camera, given their rows."""
        indices = [row.index for row in rows]
        trajectory = self.load_trajectory(camera_name)
        poses = list(trajectory.T_world_camera)
        if len(rows) < len(poses) and self._was_killed():
            poses = poses[: len(rows)]  # killed between writing the two files
        if len(indices) != len(poses):
            raise FormatError(
                f"has {len(poses)} poses, {self.frames.name} has {len(indices)} tracked frames.",
                file=self.trajectory_of(camera_name),
                hint="restore the file, or run `splatbot map` again",
            )
        return dict(zip(indices, poses, strict=True))

    def load_covariances(self) -> NDArray[np.float64] | None:
        """Load the covariances (N, 6, 6) of the tracked frames of the first camera, or None if they are unknown."""
        packed = [row.covariance for row in self.load_frames() if row.tracked and not row.camera_name]
        if not packed or any(values is None or len(values) != 21 for values in packed):
            return None
        full = np.zeros((len(packed), 6, 6))
        upper = np.triu_indices(6)
        full[:, upper[0], upper[1]] = full[:, upper[1], upper[0]] = np.array(packed)
        return full

    def check(self) -> bool:
        """Check every file against its checksum; return False if the run has none, as after it was killed.

        Raises:
            FormatError: a file is missing or altered, or the list of checksums is damaged.
        """
        sums = read_sums(self.path)
        for name in sums or ():
            check_file(self._require(self.path / name))
        return sums is not None

    def _files(self) -> list[str]:
        paths = [self.config, self.trajectory, self.frames, self.metrics, self.map]
        paths += [self.report, self.map_page, self.audit, *self._further_trajectories()]
        return [path.name for path in paths]

    def _about_the_map(self) -> tuple[str, ...]:
        """Return the names of the files that describe a map, without its checksums."""
        return tuple(path.name for path in (self.report, self.map_page, self.audit, self.measured))

    def _further_trajectories(self) -> list[Path]:
        return sorted(self.path.glob("trajectory-*.tum"))

    def _replace(self, path: Path, text: str) -> None:
        """Write a file, and its checksum if the run has checksums; killed in between, the run has none."""
        listed = self.check()
        if listed:
            (self.path / SUMS).unlink()
        write_text(text)(path)
        if listed:
            write_sums(self.path, self._files())

    def _was_killed(self) -> bool:
        """Return whether the run neither ended nor was interrupted."""
        return self.metrics.is_file() and not self.load_metrics().get("finished", True)

    def _require(self, path: Path) -> Path:
        if not path.is_file():
            check_run_folder(self.path)
            raise FormatError("is missing.", file=path, hint=_NOT_A_RUN)
        check_file(path)
        return path


def _writer(trajectory: Trajectory) -> Callable[[Path], None]:
    return lambda path: _save_trajectory(trajectory, path)


def _save_trajectory(trajectory: Trajectory, path: Path) -> None:
    if len(trajectory):
        trajectory.save(path)
    else:
        write_text("# no frame was tracked\n")(path)


def _metrics_text(metrics: Mapping[str, Any]) -> str:
    return json.dumps(metrics, indent=2, allow_nan=False) + "\n"
