"""Comparisons as self-contained HTML pages: sim-to-real of a log, sim-to-sim of a held-out twin."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.rasterize.views import depth_limits
from splatbot.report.images import CaptionedView, colour_png, comparison, depth_png
from splatbot.report.parts import details, document, image, note, pictures, section, table, tiles
from splatbot.results.units import NONE, count, decibels, metres, number, percent
from splatbot.sim.compare.agreement import Interval
from splatbot.sim.compare.log_twin import KIND, LogComparison
from splatbot.sim.compare.plots import frames_plot, policies_plot, replay_plot
from splatbot.sim.compare.trials import KIND as SIM_TO_SIM
from splatbot.sim.compare.trials import TrialResults
from splatbot.sim.compare.views import SeenView, ViewAgreement

_STOPPED = '<section class="banner warn"><b>Interrupted</b>; these are the results until then.</section>\n'


def log_rows(found: LogComparison) -> list[tuple[str, str]]:
    """Format the results of a sim-to-real comparison as names and values."""
    s = found.summary()
    rows = [
        ("camera poses", found.poses),
        ("base in the map", found.base.source + _residual(s, found.base.left_out)),
        ("support plane", "no plane within reach" if found.support is None else _support(*found.support)),
    ]
    for part, name in (("all", "frames"), ("held_out", "held-out frames")):
        v = s[part]
        if not v["frames"]:
            continue
        rows += [
            (name, f"{v['frames']} of {found.frames}"),
            ("  PSNR", decibels(v["psnr_db"])),
            (
                "  depth L1, whole image",
                f"{metres(v['depth_l1_m'])}, median {metres(v['depth_median_m'])}, covers {percent(v['coverage'])}",
            ),
            ("  depth L1, simulated part", f"{metres(v['part_l1_m'])}; collision geometry {metres(v['physics_l1_m'])}"),
            ("  silhouette IoU", f"{number(v['iou'], 3)}; collision geometry {number(v['physics_iou'], 3)}"),
        ]
    return [*rows, *_replay_rows(found, s)]


def log_section(found: LogComparison) -> list[str]:
    """Return the sections of a page on a log."""
    rows = log_rows(found)
    replayed = found.replay
    return [
        _STOPPED if found.interrupted else "",
        tiles(_tiles(found)),
        section(
            f"{KIND}: {html.escape(found.log)} against the twin of {html.escape(found.map)}", table(("", ""), rows)
        ),
        section(
            "Side by side", *(_view(view, found.shown[view.index]) for view in found.views if view.index in found.shown)
        ),
        section("Over the frames", image(frames_plot(found.views), "figures over the frames"), _rings()),
        section(
            "Replay of the arm's motion",
            image(replay_plot(replayed), "tool error over the frames"),
            note(html.escape("; ".join((replayed.source, *replayed.notes)))),
        )
        if replayed is not None
        else "",
        section("Conversion of the map", *(note(html.escape(text)) for text in found.notes)),
    ]


def log_html(found: LogComparison) -> str:
    """Return the page of a sim-to-real comparison."""
    return document(f"{found.log}: {KIND}", f"twin of {found.map}, arm {found.robot}", log_section(found))


def policy_rows(found: TrialResults) -> list[tuple[str, ...]]:
    """Format the policies of a sim-to-sim comparison as cells; the last rows are measures over all policies."""
    agreed = found.agreement()
    if agreed is None:
        return []
    rows = [(p.name, _share(p.in_map), _share(p.in_held_out), _signed(p.drop), str(p.refused)) for p in agreed.policies]
    mean = ("mean drop", "", "", _signed(agreed.drop), "")
    correlation = ("Pearson r", "", "", _signed(agreed.pearson), "")
    return [*rows, mean, correlation, ("mean maximum rank violation", "", "", _signed(agreed.mmrv), "")]


POLICY_HEAD = ("policy", "success, map's twin", "success, held-out twin", "drop", "refused")


def promise_rows(found: TrialResults) -> list[tuple[str, ...]]:
    """Format certified clearance against that simulated in the held-out twin as cells."""
    return [
        (
            f"{1e3 * row.low:g} to {1e3 * row.high:g} mm" if np.isfinite(row.high) else f"{1e3 * row.low:g} mm or more",
            str(row.count),
            _share(row.kept),
            str(row.in_contact),
            metres(row.promised),
            metres(row.measured),
            f"{-1e3 * row.worst:+.1f} mm",
        )
        for row in found.reliability()
    ]


PROMISE_HEAD = (
    "certified",
    "motions",
    "kept",
    "with contact",
    "median certified",
    "median simulated",
    "worst excess over certified",
)


def trials_title(found: TrialResults) -> str:
    """Return a heading of the results in one line."""
    return f"{SIM_TO_SIM}: {found.task}, the map's twin against the held-out twin, {len(found.cases)} cases"


def trials_section(found: TrialResults) -> list[str]:
    """Return the sections of a page on policies in two twins."""
    agreed = found.agreement()
    whys = Counter((trial.policy, trial.why_held_out) for trial in found.trials if trial.why_held_out)
    failures = [(policy, why, str(n)) for (policy, why), n in whys.most_common(40)]
    return [
        _STOPPED if found.interrupted else "",
        section(
            html.escape(trials_title(found)),
            table(POLICY_HEAD, policy_rows(found)),
            note("Rates and differences have 95 % intervals: Wilson's for rates, bootstrap over cases for others."),
            image(policies_plot(agreed), "success in both twins") if agreed is not None else "",
        ),
        section(f"Certified clearance, {html.escape(found.task)}", table(PROMISE_HEAD, promise_rows(found))),
        details(f"Failures in the held-out twin, {html.escape(found.task)}", table(("policy", "reason", ""), failures)),
    ]


def trials_html(results: Sequence[TrialResults]) -> str:
    """Return the page of a sim-to-sim comparison."""
    parts = [part for found in results for part in trials_section(found)]
    return document(f"held-out twin: {SIM_TO_SIM}", "policies that use only a map, in its twin and in another", parts)


def _share(interval: Interval) -> str:
    if interval.value is None:
        return NONE
    return f"{percent(interval.value)} ({percent(interval.low)} to {percent(interval.high)})"


def _signed(interval: Interval) -> str:
    if interval.value is None:
        return interval.note
    ends = NONE if interval.low is None or interval.high is None else f"{interval.low:.2f} to {interval.high:.2f}"
    return f"{interval.value:.2f} ({ends})" + (f"; {interval.note}" if interval.note else "")


def _tiles(found: LogComparison) -> list[tuple[str, str]]:
    s = found.summary()
    v = s["all"]
    return [
        (count(v["frames"]), "frames"),
        (decibels(v.get("psnr_db")), "PSNR"),
        (metres(v.get("part_l1_m")), "depth L1, simulated part"),
        (metres(v.get("physics_l1_m")), "depth L1 of the collision geometry"),
        (number(v.get("iou"), 3), "silhouette IoU"),
        (metres(s.get("replay_most_m")), "maximum tool error"),
    ]


def _view(view: ViewAgreement, seen: SeenView) -> str:
    name = f"frame {view.index}, recorded{' (held out)' if view.held_out else ''}"
    recorded = CaptionedView(seen.rgb, seen.depth, name, "recorded depth")
    error = f"twin's depth, median error {metres(view.depth_median_m)}"
    images = comparison(
        recorded, CaptionedView(seen.twin_rgb, seen.twin_depth, f"twin, {decibels(view.psnr_db)}", error)
    )
    shapes = depth_png(_as_large(seen.shape_depth, seen.depth), depth_limits(seen.depth))
    images.append((shapes, f"collision geometry, mean error {metres(view.physics_l1_m)}"))
    if seen.above is not None and seen.twin_above is not None:
        text = f"above the support: both white, only recorded red, only twin blue; IoU {number(view.iou, 3)}"
        images.append((colour_png(silhouettes(seen.above, seen.twin_above)), text))
    return pictures(images)


def silhouettes(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Draw two masks (H, W) as an image (H, W, 3): both white, only the first red, only the second blue."""
    picture = np.zeros((*a.shape, 3), np.uint8)
    picture[a & b], picture[a & ~b], picture[b & ~a] = (235, 235, 235), (217, 81, 95), (63, 134, 208)
    return picture


def _as_large(small: NDArray[np.float32], like: NDArray[np.float32]) -> NDArray[np.float32]:
    size = (like.shape[1], like.shape[0])
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)


def _rings() -> str:
    return note("Rings: frames that were kept out of the map. Depth is compared in the simulated part of the scene.")


def _residual(summary: dict[str, float | None], left_out: Sequence[int]) -> str:
    away, turn, median = (summary[f"base_{name}"] for name in ("residual_m", "residual_rad", "median_m"))
    if away is None or turn is None:
        return ""
    without = f"; the two poses are inconsistent in frames {', '.join(map(str, left_out))}" if left_out else ""
    return (
        f"; the arm's and the tracked camera differ by {metres(median)} (median), {metres(away)} and "
        f"{np.degrees(turn):.2f} deg RMS{without}"
    )


def _support(height: float, error: float) -> str:
    return f"{metres(height)} over the base, {metres(error)} RMS"


def _replay_rows(found: LogComparison, summary: dict[str, float | None]) -> list[tuple[str, str]]:
    if found.replay is None:
        return [("action replay", "not available: the log records neither joints nor tool poses")]
    rows = [("action replay", f"{found.replay.source}: {found.replay.reached} of {found.replay.poses} poses")]
    if found.replay.errors:
        rows += [(f"  tool error, {key}", _gap(summary, key)) for key in ("mean", "most")]
    contacts = ", ".join(f"{contact.part} and {contact.other}" for contact in found.replay.contacts)
    return [*rows, ("  contacts", contacts or "none"), ("  minimum clearance", metres(found.replay.clearance) or NONE)]


def _gap(summary: dict[str, float | None], key: str) -> str:
    away, turn = summary[f"replay_{key}_m"], summary[f"replay_{key}_rad"]
    assert away is not None
    assert turn is not None
    return f"{1e3 * away:.3f} mm, {np.degrees(turn):.4f} deg"
