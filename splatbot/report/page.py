"""The HTML page of a run report, with all content inline."""

from __future__ import annotations

import html
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

from splatbot.config import Config
from splatbot.report.audit import audit_section
from splatbot.report.figures import error_plot, gaussians_plot, stages_plot, trajectory_plot
from splatbot.report.images import CaptionedView, comparison
from splatbot.report.parts import details, document, image, note, pictures, section, table, tiles
from splatbot.results.audit import RunAudit
from splatbot.results.cameras import camera_rows
from splatbot.results.folder import FrameRow
from splatbot.results.scoring import ShownView, TrajectoryScore, ViewScores
from splatbot.results.units import count, decibels, megabytes, metres, millimetres, milliseconds, percent
from splatbot.trajectory import Trajectory

_PACKAGES = ("splatbot", "torch", "numpy", "opencv-contrib-python-headless", "open3d")


def report_html(
    *,
    rows: Sequence[FrameRow],
    metrics: Mapping[str, Any],
    config: Config,
    trajectory: Trajectory,
    track: TrajectoryScore | None,
    views: ViewScores,
    map_page: str | None = None,
    audit: RunAudit | None = None,
) -> str:
    """Return the HTML page of one run.

    Args:
        rows: one per frame of the log.
        metrics: the contents of ``metrics.json``.
        config: configuration of the run.
        trajectory: the tracked poses.
        track: score of the trajectory. If None, there is no reference.
        views: the held-out views.
        map_page: file next to the report with the interactive map. If None, there is no such file.
        audit: the map against measured depth. If None, it was not audited.
    """
    name = str(metrics["log"]["name"])
    parts = [
        _banner(metrics),
        _tiles(metrics),
        section("Trajectory", image(trajectory_plot(trajectory, track), "trajectory"), _no_reference(track)),
        section("Error over time", image(error_plot(rows, track), "position error over time")),
        section("Degraded and lost frames", _verdicts(rows)),
        *_cameras(metrics["cameras"]),
        section("Held-out views", *(_view(view) for view in views.shown), _views_note(metrics, views)),
        audit_section(audit),
        section("Time per frame", image(stages_plot(rows), "milliseconds per stage"), _stages(metrics), _pace(metrics)),
        section("Map", _map_frame(map_page), image(gaussians_plot(rows), "Gaussians over frames")),
        section("Simulated sensor effects", _effects(metrics["effects"])),
        details("Configuration", f"<pre>{html.escape(config.to_yaml())}</pre>"),
        details("Versions", table(("", ""), _versions())),
    ]
    source = str(metrics["log"].get("uri", name))
    return document(name, source, parts)


def _banner(metrics: Mapping[str, Any]) -> str:
    if metrics["error"]:
        return f'<section class="banner"><b>The log ended early.</b> {html.escape(metrics["error"])}</section>\n'
    if metrics["interrupted"]:
        return f'<section class="banner warn">{_interruption(metrics)}</section>\n'
    return ""


def _interruption(metrics: Mapping[str, Any]) -> str:
    if metrics["cut"] == "refinement":
        return "<b>The refinement was cut short</b> after all frames; `splatbot map --resume` refines the map."
    return (
        f"<b>Interrupted</b> after {metrics['frames']} of {metrics['log']['frames']} frames; the report covers the "
        "part mapped until then."
    )


def _tiles(metrics: Mapping[str, Any]) -> str:
    ms = metrics["ms_per_frame"]
    figures = [
        (f"{metrics['tracked']}/{metrics['frames']}", "frames tracked"),
        (metres(metrics["ate_rmse_m"]), "ATE RMSE"),
        (metres(metrics["rpe_trans_rmse_m"]), "RPE per frame"),
        (decibels(metrics["psnr_holdout_db"]), "PSNR, held-out views"),
        (metres(metrics["depth_median_m"]), "median depth error"),
        (milliseconds(ms["p50"]), f"per frame (p95 {milliseconds(ms['p95'])})"),
        (count(metrics["gaussians"]), f"Gaussians, {megabytes(metrics['map_bytes'])}"),
        (megabytes(metrics["peak_rss_bytes"]), "peak memory"),
    ]
    return tiles(figures)


def _no_reference(track: TrajectoryScore | None) -> str:
    if track is not None:
        return note("The estimate is aligned to the reference by a rigid transform. The dot is the start.")
    return note("Without reference poses there is no trajectory error. The dot is the start.")


def _map_frame(page: str | None) -> str:
    if page is None:
        return ""
    name = html.escape(page)
    return (
        f'<iframe src="{name}" title="the map" loading="lazy" style="width:100%;height:28rem;border:0"></iframe>\n'
        + note(f'Drag to rotate it, or open <a href="{name}">{name}</a>, which is in the same folder.')
    )


def _verdicts(rows: Sequence[FrameRow]) -> str:
    counts = Counter((row.verdict, reason) for row in rows if row.verdict != "ok" for reason in row.reasons or ("",))
    return table(("verdict and reason", "frames"), [(f"{v}: {r}", str(n)) for (v, r), n in counts.most_common(12)])


def _cameras(cameras: Mapping[str, Any]) -> list[str]:
    return [section("Further cameras", table(("camera", "frames and pose"), camera_rows(cameras)))] if cameras else []


def _view(view: ShownView) -> str:
    score = view.score
    seen = CaptionedView(view.rgb, view.depth, f"frame {score.index}", "sensor depth")
    error = f"map depth, median error {metres(score.depth_median_m)}"
    return pictures(
        comparison(
            seen, CaptionedView(view.rendered_rgb, view.rendered_depth, f"map, {decibels(score.psnr_db)}", error)
        )
    )


def _views_note(metrics: Mapping[str, Any], views: ViewScores) -> str:
    if not views.scores:
        return note("No held-out view was scored.")
    return note(
        f"Mean over {len(views.scores)} frames that were tracked but never mapped: PSNR "
        f"{decibels(metrics['psnr_holdout_db'])} over whole images. Where both have depth, its error is "
        f"{millimetres(metrics['depth_median_m'])} in the median and {millimetres(metrics['depth_l1_m'])} in the mean "
        f"with all outliers. The map covers {percent(metrics['depth_coverage'])} of the sensor's depth pixels."
    )


def _stages(metrics: Mapping[str, Any]) -> str:
    rows = [("frame", metrics["ms_per_frame"], metrics["frames"])]
    rows += [(name, values, values["frames"]) for name, values in metrics["stages"].items()]
    cells = [(name, *(milliseconds(v[p]) for p in ("p50", "p95", "p99")), str(n)) for name, v, n in rows]
    return table(("stage", "p50", "p95", "p99", "frames"), cells)


def _pace(metrics: Mapping[str, Any]) -> str:
    if metrics["paced"] is None:
        return ""
    return note(
        f"Frames came {metrics['paced']}: {metrics['late']} were not done when the next one arrived, "
        f"{metrics['dropped']} were dropped because a newer one had arrived."
    )


def _effects(effects: Sequence[Mapping[str, Any]]) -> str:
    cells = [(e["name"], e["why"], milliseconds(e["ms_per_frame"]), str(e["frames"])) for e in effects]
    return table(("effect", "why", "per frame", "frames"), cells)


def _versions() -> list[tuple[str, str]]:
    found = [("python", platform.python_version()), ("platform", platform.platform())]
    for package in _PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:  # for example in a checkout that is not installed
            found.append((package, "not installed"))
    return found
