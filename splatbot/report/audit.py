"""Audit of a run as tables and a picture of the missed surface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np

from splatbot.collision.audit import CONSTANTS as AUDIT
from splatbot.report.parts import image, note, section, table
from splatbot.report.theme import BLUE, RED, figure, png, styled
from splatbot.results.audit import RunAudit
from splatbot.results.units import NONE, count, metres

_MOST_HOLES = 5


def percentage(share: float | None) -> str:
    """Format a fraction 0..1 in % with three decimals."""
    return NONE if share is None else f"{100 * share:.3f} %"


def verdict_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the main figures of an audit as names and values."""
    holes = summary["holes"]
    return [
        ("confirmed surface points", f"{count(summary['points_confirmed'])} of {count(summary['points_proposed'])}"),
        (f"missed within {summary['working_distance_m']:g} m", percentage(summary["missed_share"])),
        ("surface error of 99.9 %", metres(summary["surface_error_q999_m"])),
        ("largest hole", metres(holes[0]["length_m"]) if holes else "none"),
        ("confirmed free points", count(summary["points_free"])),
        ("false hits in free space", percentage(summary["false_hit_share"])),
    ]


def distance_rows(summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row of text for each depth range with points."""
    return [
        (
            f"{row['from_m']:g} to {row['to_m']:g} m",
            count(row["points"]),
            percentage(row["missed_share"]),
            metres(row["surface_error_q999_m"]),
        )
        for row in summary["by_distance"]
        if row["points"]
    ]


def object_rows(summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row of text for each object."""
    return [
        (row["name"], count(row["points"]), percentage(row["missed_share"]), metres(row["worst"]))
        for row in summary["by_object"]
    ]


def hole_rows(summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row of text for each of the largest holes."""
    return [
        (
            f"{metres(hole['length_m'])} x {metres(hole['width_m'])}",
            metres(hole["depth_m"]),
            ", ".join(f"{x:.3f}" for x in hole["center_m"]),
        )
        for hole in summary["holes"][:_MOST_HOLES]
    ]


def audit_section(audit: RunAudit | None) -> str:
    """Return the section of the run report; empty if the run was not audited."""
    if audit is None:
        return ""
    summary = audit.summary()
    return section(
        "Surfaces seen and missed",
        table(("", ""), verdict_rows(summary)),
        image(audit_png(audit), "missed surface points, and distances of the surface from the map"),
        table(("distance", "points", "missed", "99.9 %"), distance_rows(summary)),
        table(("object", "points", "missed", "largest"), object_rows(summary)),
        table(("largest holes", "depth", "centre [m]"), hole_rows(summary)),
        note(
            "A surface point counts if two other frames measured it and hardly any frame saw through it; it is missed "
            "if it is more than 1 cm from the collision field. <code>splatbot audit RUN</code> repeats the audit."
        ),
    )


@styled
def audit_png(audit: RunAudit) -> bytes:
    """Plot the missed points in the frame that shows most of the largest hole, and the distances of the surface.

    Without a hole, it is the frame that shows most missed points.
    """
    fig, (left, right) = figure(2, height=3.4)
    left.imshow(audit.picture)
    left.plot(*audit.marks.T, ".", color=RED, markersize=2)
    left.set_axis_off()
    left.set_title(f"frame {audit.index}: {len(audit.marks)} missed points", fontsize=9)
    near = audit.audit.within()
    bins = np.linspace(0.0, 0.03, 61)
    if len(near.distance):
        weights = np.full(len(near.distance), 100.0 / len(near.distance))
        right.hist(1e3 * np.minimum(near.distance, bins[-1]), bins=list(1e3 * bins), weights=weights, color=BLUE)
    right.axvline(1e3 * AUDIT.missed_distance, color=RED, linewidth=1.0, linestyle="--", label="missed beyond")
    right.set_yscale("log")
    right.set_ylim(1e-3, 150)
    right.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    right.set_xlabel(f"distance from the field within {AUDIT.working_distance:g} m [mm]")
    right.set_ylabel("confirmed surface [%]")
    right.legend(loc="upper right")
    return png(fig)
