"""`splatbot map`."""

from __future__ import annotations

import os
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from splatbot.cli.cameras import is_live, open_recorded, refuse_with_camera
from splatbot.cli.doubts import camera_doubts, run_doubts
from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_camera, check_file, check_output, check_state
from splatbot.cli.placing import named_robot
from splatbot.errors import InputError
from splatbot.layouts import MAP_NAME, RECORDING, is_camera, log_kind

if TYPE_CHECKING:
    from splatbot.logs import Log
    from splatbot.run import RunResult
    from splatbot.run.state import SavedRun


def map_log_command(
    log: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="LOG|CAMERA")] = "",
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    overrides: Annotated[
        tuple[str, ...], tyro.conf.arg(name="set", metavar="KEY=VALUE"), tyro.conf.UseAppendAction
    ] = (),
    budget_ms: Annotated[float | None, tyro.conf.arg(metavar="MS")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    on_bad_frame: Literal["stop", "skip"] = "stop",
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    first_frame: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    seconds: Annotated[float | None, tyro.conf.arg(metavar="S")] = None,
    realtime: bool = False,
    rate: Annotated[float | None, tyro.conf.arg(metavar="HZ")] = None,
    save_every: Annotated[float, tyro.conf.arg(metavar="S")] = 30.0,
    resume: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    localise: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    overwrite: bool = False,
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    no_report: bool = False,
    dump_config: bool = False,
    quiet: bool = False,
) -> int:
    """Turn an RGB-D log, or the frames of a camera, into a map of Gaussians.

    Writes a run folder: map.ply, trajectory.tum, metrics.json, frames.jsonl, config.yaml, audit.json, report.html and
    map.html. Ctrl-C saves the current map; so does a frame that cannot be read. Every 30 s, and after the last frame,
    the whole state is saved too (RUN/state), for --resume and --localise.

    A camera is recorded into RUN/recording.mcap while it is mapped, until Ctrl-C, --seconds or --max-frames.

    Examples:
        splatbot map recordings/desk
        splatbot map recordings/desk --out runs/desk --set mapping.max_gaussians=50000
        splatbot map rgbd_dataset_freiburg1_desk --camera tum_fr1
        splatbot map recordings/desk --budget-ms 30 --realtime --rate 30
        splatbot map "synthetic:tabletop?frames=40" --out runs/tabletop
        splatbot map oak:// --out runs/desk --seconds 60
        splatbot map --resume runs/desk
        splatbot map recordings/desk_again --localise runs/desk
        splatbot map recordings/wrist --robot panda
        splatbot map --dump-config > mine.yaml

    Args:
        log: a folder in TUM or Replica layout, a recording of ROS topics (.mcap, rosbag2 folder, .bag), or
            synthetic:SCENE?... (see splatbot simulate --list). `LOG?pair_within=0.05` pairs colour and depth up to
            0.05 s apart (0.02 s by default). A camera is oak://, realsense:// or replay:LOG
            (docs/guide/cameras.md). A .yaml file lists several logs or several cameras
            (docs/guide/several-cameras.md).
        out: folder to write; by default runs/NAME-TIME, with a link runs/latest.
        config: YAML file; environment variables (SPLATBOT_MAPPING__MAX_GAUSSIANS=...) and then --set override it.
        overrides: one key of the configuration, as in mapping.max_gaussians=50000.
        budget_ms: time for tracking one frame, 100 by default; 30, 300 and 1000 have other settings. As --set
            tracking.budget_ms=MS; counted in work, so that runs repeat, unless --realtime.
        camera: intrinsics instead of the log's own: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
        on_bad_frame: reaction to a frame that cannot be read: save and stop, or skip it.
        max_frames: read at most N frames.
        first_frame: number of the first frame to read; frames count from 0. A resumed run keeps its own.
        seconds: with a camera, end after this time.
        realtime: feed frames at the times of their stamps, map in parallel with tracking, and drop late frames.
        rate: as realtime, at this rate [Hz].
        save_every: time between two saves of the state [s]; 0 never saves it.
        resume: continue a run that was killed or interrupted, in its own folder unless --out is given. Give LOG only
            if the log has moved.
        localise: localise the frames in the map of this run instead of building one. The first pose is
            arbitrary, and is accepted when the second agrees.
        overwrite: replace the run that --out holds.
        robot: mask this robot in the frames, by the log's joints.txt and the T_link_camera of its scene.yaml.
        no_report: write no audit, report.html and map.html, which take seconds; `splatbot audit RUN` audits later.
        dump_config: print the configuration in force and leave.
        quiet: no progress and no summary, only errors.
    """
    check_file(config, "--config")
    if (resume or localise) and (config or overrides or budget_ms is not None):
        hint = "leave --config, --set and --budget-ms out, or map the log again"
        raise InputError("a saved run keeps its configuration.", field="--config, --set, --budget-ms", hint=hint)
    if not dump_config:
        device = is_live(log)
        if first_frame and (device or resume is not None):
            hint = "leave it out: a camera begins now, and a resumed run where it ended"
            raise InputError("is for a log.", field="--first-frame", hint=hint)
        if device:
            refuse_with_camera({"--camera": camera, "--robot": robot, "--resume": resume, "--rate": rate})
        elif seconds is not None:
            raise InputError("is for cameras.", field="--seconds", hint="give --max-frames")
        _check(log, out, resume, localise, max_frames=max_frames, overwrite=overwrite)
        check_camera(camera)
        if robot is not None:
            named_robot(robot)

    from splatbot.config import load_config

    given = _parse_overrides(overrides) | ({} if budget_ms is None else {"tracking.budget_ms": budget_ms})
    settings = load_config(config, overrides=given)
    if dump_config:
        print(settings.to_yaml(), end="")
        return 0

    from splatbot.cli.map_page import page_of_map
    from splatbot.cli.progress import progress_display
    from splatbot.logs.live import recover_recording
    from splatbot.robots.in_view import open_without_robot
    from splatbot.run import map_log

    if resume is not None:
        recover_recording(resume / RECORDING)  # of a camera whose run was killed
    saved = _saved_run(resume, localise)
    if resume is not None and saved is not None:
        log, camera, out = log or saved.place.uri, camera or saved.place.camera, out or resume
        robot = robot or saved.place.robot
    ends = ExitStack()
    if device:
        folder = out or _new_folder(Path(log).stem if log.endswith((".yaml", ".yml")) else log.partition("?")[0])
        path = folder / RECORDING
        recorded = open_recorded(log, path, max_frames=max_frames, seconds=seconds, overwrite=overwrite)
        recording: Log = recorded
        ends.callback(recorded.close)
    else:
        recording = open_without_robot(log, robot, camera=camera)
        folder = out or _new_folder(recording.name)
    if not quiet:
        for doubt in camera_doubts(recording.camera):
            print_message("question", doubt)
    with ends, progress_display(quiet=quiet) as on_progress:
        result = map_log(
            recording,
            config=settings,
            out=folder,
            on_progress=on_progress,
            on_bad_frame=on_bad_frame,
            max_frames=max_frames,
            first_frame=first_frame,
            realtime=realtime,
            rate=rate,
            save_every=save_every if save_every > 0 else None,
            resume=saved if resume is not None else None,
            localise=saved if localise is not None else None,
            source={"camera": _lasting(camera) if camera else None, "robot": robot},
            map_page=page_of_map,
            report=not no_report,
        )
    if out is None:
        _link_latest(folder)
    if not quiet:
        _print_summary(result)
    if result.error is not None:
        print_message("error", result.error)
    return result.exit_code


def _check(
    log: str,
    out: Path | None,
    resume: Path | None,
    localise: Path | None,
    *,
    max_frames: int | None,
    overwrite: bool,
) -> None:
    """Refuse wrong paths before the libraries load."""
    if resume is not None and localise is not None:
        raise InputError("excludes --resume.", field="--localise", hint="give the one or the other")
    if not log and resume is None:
        raise InputError("is missing.", field="LOG", hint="name a recording: splatbot map LOG")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"is {max_frames}.", field="--max-frames", hint="give at least 1")
    for flag, saved in (("--resume", resume), ("--localise", localise)):
        if saved is not None:
            check_state(saved, flag)
    if log and not is_camera(log):
        log_kind(log)
    if resume is None or (out is not None and out.resolve() != resume.resolve()):
        check_output(out or Path("runs"))
        _check_overwrite(out, overwrite=overwrite)


def _check_overwrite(out: Path | None, *, overwrite: bool) -> None:
    if out is None or overwrite:
        return
    found = [name for name in (MAP_NAME, RECORDING, "metrics.json", "trajectory.tum", "state") if (out / name).exists()]
    if found:
        hint = f"give another folder, --overwrite to replace it, or --resume {out} to continue it"
        raise InputError(f"holds a run already ({', '.join(found)}).", file=out, field="--out", hint=hint)


def _saved_run(resume: Path | None, localise: Path | None) -> SavedRun | None:
    from splatbot.run.state import SavedRun

    folder = resume or localise
    return SavedRun.load(folder) if folder is not None else None


def _parse_overrides(pairs: tuple[str, ...]) -> dict[str, Any]:
    import yaml

    from splatbot.errors import ConfigError

    values: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"is {pair!r}.", field="--set", hint="write --set SECTION.KEY=VALUE")
        try:
            values[key.strip()] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"{text!r} is not a YAML value.", field=f"--set {key}", hint="quote the value") from error
    return values


def _lasting(camera: str) -> str:
    """Return an absolute path of a file, so that the run can be scored from any folder; keep names of presets."""
    return str(Path(camera).resolve()) if Path(camera).exists() else camera


def _new_folder(name: str) -> Path:
    return Path("runs") / f"{_slug(name)}-{datetime.now():%Y%m%d-%H%M%S}"


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip("-.") or "run"


def _link_latest(folder: Path) -> None:
    link = folder.parent / "latest"
    if link.exists() and not link.is_symlink():
        return  # a folder of the user
    fresh = folder.parent / f".latest-{os.getpid()}"
    fresh.symlink_to(folder.name)
    fresh.replace(link)


def _pace(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    paced = metrics["paced"]
    if paced is None:
        return []
    return [("paced", f"{metrics['late']} frames late, {metrics['dropped']} dropped")]


def _sensor(timing: dict[str, Any] | None) -> list[tuple[str, str]]:
    if timing is None:
        return []
    readout, delay = 1e3 * timing["readout_s"], 1e3 * timing["depth_delay_s"]
    shutter = [f"rolling shutter {readout:.0f} ms"] if readout else []
    late = [f"depth {abs(delay):.0f} ms {'late' if delay > 0 else 'early'}"] if delay else []
    return [("sensor, estimated", ", ".join(shutter + late))]


def _mishaps(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    counts = [f"{metrics[name]} {name}" for name in ("lost", "degraded") if metrics[name]]
    return [("of them", ", ".join(counts))] if counts else []


def _print_summary(result: RunResult) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.results.cameras import camera_rows
    from splatbot.results.units import count, decibels, megabytes, metres, milliseconds

    m = result.metrics
    ms = m["ms_per_frame"]
    rows = [
        ("frames tracked", f"{m['tracked']} of {_intended(m)}" + (f", {m['skipped']} skipped" if m["skipped"] else "")),
        *_mishaps(m),
        *_pace(m),
        *_sensor(m.get("sensor_timing")),
        ("ATE RMSE", metres(m["ate_rmse_m"]) + (" from the log's reference poses" if m["ate_frames"] else "")),
        ("PSNR, held-out views", decibels(m["psnr_holdout_db"])),
        ("depth error, median", metres(m["depth_median_m"])),
        *((f"camera {name}", text) for name, text in camera_rows(m["cameras"])),
        ("Gaussians", f"{count(m['gaussians'])}, {megabytes(m['map_bytes'])}"),
        ("time per frame", f"median {milliseconds(ms['p50'])}, 95 % {milliseconds(ms['p95'])}"),
        *(("question", doubt) for doubt in run_doubts(m)),
        *([("report", str(result.folder / "report.html"))] if (result.folder / "report.html").exists() else []),
        *([("to go on", f"splatbot map --resume {result.folder}")] if m["cut"] == "mapping" else []),
    ]
    print_table(rows, title=f"{m['log']['name']}: {_ending(m)}")


def _intended(metrics: dict[str, Any]) -> int:
    """Return the number of frames to track: all processed ones, or those of the log if the mapping ended early."""
    ended_early = metrics["cut"] == "mapping" or metrics["error"]
    return int((metrics["frames_planned"] if ended_early else None) or metrics["frames"])


def _ending(metrics: dict[str, Any]) -> str:
    """Return the words for the end of a run."""
    if metrics["error"]:
        return "stopped early; saved"
    if not metrics["interrupted"]:
        return "mapped"
    return {"mapping": "interrupted; saved", "refinement": "mapped, refinement cut short; saved"}.get(
        metrics["cut"], "mapped, scores and report cut short; saved"
    )
