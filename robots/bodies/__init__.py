"""Certified bodies: spheres that contain the meshes of an arm's maker, fitted by `splatbot robot fit` and kept here."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.protocols import Array, LinkSpheres
from splatbot.robots.containment import open_pieces, slack_of
from splatbot.robots.cover import FINE, cover_solids
from splatbot.robots.maker_meshes import ReportProgress, Source


@dataclass(frozen=True, eq=False)
class Body:
    """Spheres of an arm's parts.

    Args:
        source: distribution, version, licence and digest of the meshes.
        slack: [m] distance that the fit was given.
        parts: name of each part: (S, 4) spheres (x, y, z, radius) in its frame [m].
    """

    source: dict[str, str]
    slack: float
    parts: dict[str, Array]

    def on(self, part: str, link: int, T_link_part: Array | None = None) -> LinkSpheres:
        """Return the spheres of a part that is fixed to a link with the pose ``T_link_part`` (4, 4)."""
        spheres = self.parts[part]
        T = np.eye(4) if T_link_part is None else T_link_part
        return LinkSpheres(
            np.full(len(spheres), link, np.int32), spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3].copy()
        )


def joined(*parts: LinkSpheres) -> LinkSpheres:
    """Join spheres, sorted by link."""
    link = np.concatenate([part.link for part in parts])
    order = np.argsort(link, kind="stable")
    centers = np.concatenate([part.centers for part in parts])
    return LinkSpheres(
        link[order], np.ascontiguousarray(centers[order]), np.concatenate([p.radii for p in parts])[order]
    )


def body_file(name: str) -> Path:
    """Return the file of a body that splatbot ships."""
    return Path(__file__).parent / f"{name}.json"


def load_body(name: str) -> Body:
    """Load a body that splatbot ships.

    Raises:
        FormatError: the file is missing or damaged.
    """
    path = body_file(name)
    try:
        document = json.loads(path.read_text())
        parts = {
            part: np.array(spheres, dtype=np.float64).reshape(-1, 4) for part, spheres in document["parts"].items()
        }
        return Body(document["source"], float(document["slack"]), parts)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"is no body ({error}).", file=path, hint="fit it again: splatbot robot fit") from error


def fit_body(source: Source, slack: float, report_progress: ReportProgress) -> Body:
    """Fit spheres to the meshes of every part, and prove that the rounded numbers of the file contain them.

    Raises:
        InputError: the meshes are not installed, or the proof fails.
    """
    parts = {}
    for part in source.parts:
        shapes = source.shapes(part)
        spheres = np.c_[rounded(*cover_solids(shapes, slack * source.share.get(part, 1.0), FINE))]
        triangles = np.concatenate([shape.triangles() for shape in shapes])
        if len(open_pieces(triangles, spheres[:, :3], spheres[:, 3])):
            raise InputError("is not contained after rounding.", field=part, hint="fit with another slack")
        parts[part] = spheres
        measured = slack_of(shapes, spheres[:, :3], spheres[:, 3])
        report_progress(
            f"{part}: {len(spheres)} spheres, slack {1e3 * measured.median:.1f} mm in the median, "
            f"{1e3 * measured.most99:.1f} mm at 99 %, {1e3 * measured.largest:.1f} mm at most"
        )
    found = {
        "package": f"{source.package} {source.version()}",
        "origin": source.origin,
        "licence": source.licence,
        "sha256": source.digest(),
    }
    return Body(found, slack, parts)


def rounded(centers: Array, radii: Array) -> tuple[Array, Array]:
    """Round spheres (S, 3), (S,) to 10 µm, such that the new ones contain the old ones."""
    return np.round(centers, 5), np.ceil((radii + 1e-5) * 1e5) / 1e5


def save_body(body: Body, path: Path) -> None:
    """Write a body as JSON, a sphere a line."""
    lines = {
        part: ",\n".join(f"   {json.dumps(row)}" for row in spheres.tolist()) for part, spheres in body.parts.items()
    }
    parts = ",\n".join(f'  "{part}": [\n{rows}\n  ]' for part, rows in lines.items())
    head = json.dumps({"source": body.source, "slack": body.slack}, indent=1)[:-2]
    with atomic_write(path) as file:
        file.write(f'{head},\n "parts": {{\n{parts}\n }}\n}}\n'.encode())
