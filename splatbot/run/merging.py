"""merge_runs: two runs of one place become one run, in the world of the first."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from splatbot.atomic import write_text
from splatbot.errors import InputError
from splatbot.geometry import adjoint, inverse, rotation_to_quat
from splatbot.logs import open_log
from splatbot.logs.consecutive import ConsecutiveLog
from splatbot.logs.listed import stamps_of
from splatbot.mapping.alignment import MapAlignment, align_maps
from splatbot.mapping.depth_fusion import DepthNoiseModel
from splatbot.mapping.joining import JoinedModel, join_models, without_contradicted
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.rigid_motion import move_gaussians, move_keyframe
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.merge_output import (
    RECORDINGS,
    SUMMARY,
    check_merge,
    draft_of,
    earlier_run,
    replace_run,
    restore_run,
)
from splatbot.run.interrupts import Interrupts
from splatbot.run.job import RunResult, map_log
from splatbot.run.outcome import MapPage
from splatbot.run.progress import Progress
from splatbot.run.state import Checkpoint, SavedRun
from splatbot.slam import FrameResult, Slam

MAX_KEYFRAMES = 4000
"""Largest number of keyframes of the merged run: the images of as many at 640 x 480 take 9 GB."""


@dataclass(frozen=True, eq=False)
class MergedRun:
    """Result of a merge.

    Args:
        run: the merged run.
        alignment: pose of B in A.
        joined: the common Gaussians, before the last refinement.
        time_offset: time [s] that is added to the stamps of B.
        saved: whether the folder has the merged run. One that ended early does not replace another run.
    """

    run: RunResult
    alignment: MapAlignment
    joined: JoinedModel
    time_offset: float
    saved: bool = True

    def summary(self) -> dict[str, Any]:
        """Return the figures of the merge under the stable keys of ``merge.json``."""
        return merge_figures(self.alignment, self.joined, self.time_offset)


def merge_figures(alignment: MapAlignment, joined: JoinedModel, time_offset: float) -> dict[str, Any]:
    """Return the figures of a merge, for JSON."""
    return {
        "T_a_b": pose_of(alignment),
        "keyframes_tried": alignment.tried,
        "keyframes_found": alignment.found,
        "keyframes_agreeing": len(alignment.located),
        "overlap": joined.overlap,
        "gaussians_kept": joined.kept,
        "gaussians_removed": joined.removed,
        "gaussians_added": joined.added,
        "gaussians_covered": joined.covered,
        "time_offset_s": time_offset,
    }


def pose_of(alignment: MapAlignment) -> dict[str, Any]:
    """Return the pose of map B in map A with its standard deviations, for JSON."""
    moved, turned = alignment.sigmas
    return {
        "translation_m": alignment.T_a_b[:3, 3].tolist(),
        "quaternion_wxyz": rotation_to_quat(alignment.T_a_b[:3, :3]).tolist(),
        "translation_sigma_m": moved,
        "rotation_sigma_rad": turned,
    }


def load_run(run: str | Path) -> SavedRun:
    """Load the state of a run of one camera, with its last loop closed.

    Raises:
        FormatError: the state is missing or damaged.
        InputError: the run has several cameras, or no keyframes.
    """
    saved = SavedRun.load(run)
    saved.slam.close_loops()
    if saved.config.cameras:
        raise InputError("has several cameras.", file=run, field="cameras", hint="map the recording of one camera")
    if not saved.slam.keyframes:
        raise InputError("has no keyframes.", file=run, field="RUN", hint="map its log again")
    return saved


def locate_run(
    a: SavedRun, b: SavedRun, report: Callable[[float], None] = lambda _share: None, *, otherwise: str = ""
) -> MapAlignment:
    """Locate the map of run B in that of run A, see :func:`splatbot.mapping.alignment.align_maps`.

    Args:
        a, b: the runs.
        report: called with the finished share.
        otherwise: end of the hint of an error, a way that needs no alignment.

    Raises:
        InputError: B is not found in A.
    """
    try:
        return align_maps(a.slam.keyframes, b.slam.keyframes, b.config, report)
    except InputError as error:
        raise InputError(error.message, file=b.folder, field=error.field, hint=f"{error.hint}{otherwise}") from error


@dataclass(frozen=True, eq=False)
class AlignedRuns:
    """Two runs, and the pose of the later one, B, in the world of A."""

    a: SavedRun
    b: SavedRun
    alignment: MapAlignment


def align_runs(
    run_a: str | Path, run_b: str | Path, report: Callable[[float], None] = lambda _share: None
) -> AlignedRuns:
    """Load two runs that can be merged, and locate B in A.

    Args:
        run_a, run_b: folders of runs with a saved state.
        report: called with the finished share of the alignment.

    Raises:
        FormatError: the state of a run is missing or damaged.
        InputError: B is not found in A, or the runs cannot be merged.
    """
    a, b = load_run(run_a), load_run(run_b)
    _check(a, b)
    return AlignedRuns(a, b, locate_run(a, b, report))


def merge_runs(
    aligned: AlignedRuns,
    *,
    out: str | Path,
    on_progress: Callable[[Progress], None] | None = None,
    map_page: MapPage | None = None,
    report: bool = True,
    overwrite: bool = False,
) -> MergedRun:
    """Merge two runs into the run folder ``out``.

    Surface of both is fused, and A loses the surface that the depth of B sees through, in its Gaussians and in its
    keyframes. The merged run is that of a log that plays both recordings (``recordings.yaml``). It is refined, scored
    and reported like a mapped one.

    Args:
        aligned: the runs. Gaussians and keyframes of B are moved; the runs on disk stay as they are.
        out: folder to write. It stays as it is until the merged run is whole, which then replaces it. An error or
            Ctrl-C before the refinement removes the unfinished run. A run that ends early during the refinement is
            saved if ``out`` holds no other one.
        on_progress: called at every phase.
        map_page: makes a page of the finished map for the report. If None, the report has no such page.
        report: audit the merged map and write the report.
        overwrite: replace the run that ``out`` holds.

    Raises:
        LogError: the recording of a run is missing.
        InputError: A and B are one run, ``out`` is one of them or holds a run, or it cannot be written.
    """
    restore_run(out)
    check_merge(aligned.a.folder, aligned.b.folder, out, overwrite=overwrite)
    draft = draft_of(out)
    try:
        shutil.rmtree(draft, ignore_errors=True)
        found = _merge_into(RunFolder.create(draft), Path(out), aligned, on_progress, map_page, report=report)
        if found.run.exit_code != 0 and earlier_run(out):
            return replace(found, saved=False)
        with Interrupts():
            replace_run(draft, out)
        return found
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _merge_into(
    folder: RunFolder,
    out: Path,
    aligned: AlignedRuns,
    on_progress: Callable[[Progress], None] | None,
    map_page: MapPage | None,
    *,
    report: bool,
) -> MergedRun:
    """Write the merged run into a folder that is later renamed to ``out``."""
    a, b, alignment = aligned.a, aligned.b, aligned.alignment
    time_offset = _write_recordings(folder.path / RECORDINGS, a, b)
    log = ConsecutiveLog(
        folder.path / RECORDINGS,
        lambda address, camera: open_log(address, camera=camera),
        uri=str((out / RECORDINGS).resolve()),
    )
    slam, joined = merged_slam(a, b, alignment, first_index=a.place.frames, time_offset=time_offset)
    index, stamp = b.place.last_index, b.place.last_stamp
    place = replace(
        b.place,
        name=log.name,
        uri=log.uri,
        frames=len(log),
        camera=None,
        next_index=len(log),
        last_index=None if index is None else a.place.frames + index,
        last_stamp=None if stamp is None else stamp + time_offset,
    )
    loop = _merged_loop(a, b)
    Checkpoint(folder.path, 0.0).save(slam, loop, place, a.config)
    merged = SavedRun(folder.path, a.config, place, slam, loop)
    result = map_log(
        log,
        out=folder.path,
        resume=merged,
        on_progress=on_progress,
        map_page=map_page,
        report=report,
        source={"camera": None},
    )
    found = MergedRun(replace(result, folder=out), alignment, joined, time_offset)
    write_text(json.dumps(found.summary(), indent=2, allow_nan=False) + "\n")(folder.path / SUMMARY)
    return found


def _check(a: SavedRun, b: SavedRun) -> None:
    """Refuse runs whose merged run could not be read again.

    Raises:
        InputError: a robot is masked in the frames of a run, or there are too many keyframes.
    """
    for saved in (a, b):
        if saved.place.robot is not None:
            hint = "map the log without --robot and with masks in the log (docs/guide/mapping.md)"
            raise InputError(f"masks the robot {saved.place.robot}.", file=saved.folder, field="robot", hint=hint)
    count = len(a.slam.keyframes) + len(b.slam.keyframes)
    if count > MAX_KEYFRAMES:
        hint = f"map with --set mapping.max_keyframes={MAX_KEYFRAMES // 2}"
        raise InputError(f"are {count}, at most {MAX_KEYFRAMES} fit.", file=b.folder, field="keyframes", hint=hint)


def _write_recordings(file: Path, a: SavedRun, b: SavedRun) -> float:
    """Write the list of the two recordings, and return the time [s] by which the stamps of B are later."""
    addresses = [str(RunFolder(saved.folder).load_metrics()["log"]["uri"]) for saved in (a, b)]
    cameras = [saved.place.camera for saved in (a, b)]
    offset = later_by(*(stamps_of(open_log(log, camera=own)) for log, own in zip(addresses, cameras, strict=True)))
    entries: list[dict[str, Any]] = []
    for log, own, later in zip(addresses, cameras, (0.0, offset), strict=True):
        camera = {} if own is None else {"camera": _absolute(own)}
        entries.append({"log": log, **camera, **({"time_offset": later} if later else {})})
    write_text(yaml.safe_dump({"recordings": entries}, sort_keys=False))(file)
    return offset


def later_by(stamps_a: Sequence[float], stamps_b: Sequence[float]) -> float:
    """Return the time [s] that is added to the stamps of B so that they follow those of A.

    Stamps of B that follow those of A stay. Otherwise B begins one mean period after A.
    """
    period = (stamps_a[-1] - stamps_a[0]) / max(len(stamps_a) - 1, 1) or 1.0
    return 0.0 if stamps_b[0] > stamps_a[-1] else round(stamps_a[-1] + period - stamps_b[0], 6)


def _absolute(address: str) -> str:
    return str(Path(address).resolve()) if Path(address).exists() else address


def merged_slam(
    a: SavedRun, b: SavedRun, alignment: MapAlignment, *, first_index: int, time_offset: float
) -> tuple[Slam, JoinedModel]:
    """Return a SLAM with the frames, keyframes and Gaussians of both runs; those of B have later numbers.

    Args:
        a, b: the runs; they do not change.
        alignment: pose of B in A.
        first_index: index of the first frame of B.
        time_offset: time [s] that is added to the stamps of B.
    """
    number = 1 + max(keyframe.number for keyframe in a.slam.keyframes)
    keyframes_b = [_moved_keyframe(keyframe, alignment.T_a_b, number) for keyframe in b.slam.keyframes]
    model_b = b.slam.snapshot().model
    anchors = {int(n): alignment.T_a_b for n in np.unique(model_b.anchors.numpy())}
    model_b = move_gaussians(model_b, anchors)
    model_b.anchors = torch.where(model_b.anchors >= 0, model_b.anchors + number, model_b.anchors)
    noise = DepthNoiseModel.of(b.config.tracking)
    joined = join_models(a.slam.snapshot().model, model_b, keyframes_b, a.config.mapping, noise)
    slam = Slam(a.config)
    slam.results = [*a.slam.results, *(_moved_result(r, alignment, first_index, time_offset) for r in b.slam.results)]
    mapper = slam._mapper
    mapper.keyframes = [*(without_contradicted(k, keyframes_b) for k in a.slam.keyframes), *keyframes_b]
    mapper.model, mapper.loops = joined.model, a.slam._mapper.loops
    mapper._refiner.adam.extend(joined.model)
    mapper._stamp = b.slam.snapshot().stamp + time_offset
    return slam, joined


def _moved_keyframe(keyframe: Keyframe, T_a_b: Array, number: int) -> Keyframe:
    return replace(move_keyframe(keyframe, {keyframe.number: T_a_b}), number=number + keyframe.number)


def _moved_result(result: FrameResult, alignment: MapAlignment, first_index: int, time_offset: float) -> FrameResult:
    """Return a result of B in the world of A; its covariance has that of T_a_b as well."""
    moved = replace(result, index=first_index + result.index, stamp=result.stamp + time_offset)
    if result.T_world_camera is None:
        return moved
    covariance = result.covariance
    if covariance is not None:
        A = adjoint(inverse(result.T_world_camera))
        covariance = covariance + A @ alignment.covariance @ A.T
    return replace(moved, T_world_camera=alignment.T_a_b @ result.T_world_camera, covariance=covariance)


def _merged_loop(a: SavedRun, b: SavedRun) -> dict[str, Any]:
    """Return the counters of both loops, with the frames of B after those of A."""
    first, later, n = a.loop["loop"], b.loop["loop"], a.place.frames
    counters = dict(first)
    for key in ("ms", "skipped"):
        counters[key] = {**first[key], **{n + index: value for index, value in later[key].items()}}
    counters["held_out"] = first["held_out"] | {n + index for index in later["held_out"]}
    for key in ("keyframes", "lost"):
        counters[key] = first[key] + later[key]
    dropped = [*a.loop["source"]["dropped"], *(n + index for index in b.loop["source"]["dropped"])]
    late = a.loop["source"]["late"] | {n + index for index in b.loop["source"]["late"]}
    return {"loop": counters, "source": {"dropped": dropped, "late": late}}
