"""`splatbot info`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.doubts import camera_doubts
from splatbot.cli.paths import check_camera, check_output
from splatbot.cli.tables import print_table
from splatbot.errors import InputError
from splatbot.layouts import is_map, is_tiled_map, log_kind, map_file

if TYPE_CHECKING:
    from splatbot.logs import Log
    from splatbot.logs.streams import Stream


@dataclass(frozen=True)
class InfoConstants:
    """Constants of the description of a log.

    Args:
        samples: frames that are decoded to describe a log.
        max_shift: [share of width] largest offset of depth and colour; sensors widen close objects by less.
    """

    samples: int = 10
    max_shift: float = 0.004


CONSTANTS = InfoConstants()


def info(
    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MAP|LOG")],
    /,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    fit_plane: bool = False,
    up: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None,
    first_frame: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    support: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    base_offset: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None,
    picture: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None,
) -> int:
    """Describe a map, a log or a run.

    Ten frames of a log describe its depth. The shift shows whether depth is registered to colour: it is the distance in
    pixels, right and down, between the edges of both.

    The streams of a TUM folder or of ROS topics are listed with their rates. "missing" counts gaps at the median
    period, and "clock" is the median time from stamp to reception.

    Examples:
        splatbot info recordings/desk --picture first.png
        splatbot info recording.mcap
        splatbot info runs/latest
        splatbot info map.ply
        splatbot info runs/latest --fit-plane
        splatbot info runs/latest --fit-plane --up 0 -1 0
        splatbot info runs/latest --fit-plane --base-offset -0.2 0.4 0.6

    Args:
        path: a map file, a run folder (its map), a tiled map, synthetic:SCENE, or a recording. Folders are of TUM,
            Replica, 7-Scenes, Open3D, ScanNet, Nerfstudio, LeRobot or rosbag2; files are .mcap, .bag, .sens or .r3d.
        camera: intrinsics of the log: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
        fit_plane: estimate the plane of the table or floor and propose a base of a robot. They are written to
            scene.yaml next to the map, with the picture scene.png. A doubtful estimate is not written.
        up: with --fit-plane, upwards in the first camera (x right, y down, z ahead). It is 0 -1 0 for a camera that
            looked ahead, and 0 0 -1 for one that looked straight down. It replaces an existing estimate. By default
            the log's accelerometer decides, if there is one, else the planes of the map.
        first_frame: describe a log from this frame on; frames count from 0.
        support: with --fit-plane, propose the base on this support of `splatbot objects`, which lists heights; the
            first one is 0.
        base_offset: with --fit-plane, move the base along its own axes [m] (x ahead, y left, z up), as for a robot on a
            pedestal. Each call moves it further.
        picture: write colour and depth of the first described frame, side by side.
    """
    from splatbot.cli.fit_plane import fit_plane as fit_plane_command

    for flag, given in (("--up", up), ("--support", support), ("--base-offset", base_offset)):
        if given is not None and not fit_plane:
            raise InputError("goes with --fit-plane.", field=flag, hint="give both")
    if first_frame and (is_tiled_map(path) or is_map(path)):
        raise InputError("needs a log.", field="--first-frame", hint="leave it out for a map")
    if is_tiled_map(path):
        return _describe_tiled(path, fit_plane=fit_plane, picture=picture)
    if is_map(path):
        if picture is not None:
            raise InputError("needs a log.", field="--picture", hint=f"splatbot render {path}")
        place = map_file(path)
        print_table(describe_map(place), title=str(place))
        return fit_plane_command(place, up, support, base_offset) if fit_plane else 0
    log_kind(path)
    check_camera(camera)
    if fit_plane:
        raise InputError("needs a map.", field="--fit-plane", hint="map the log first: splatbot map LOG")
    check_output(picture, "--picture", folder=False)
    from splatbot.logs import open_log
    from splatbot.logs.base import LogPart
    from splatbot.logs.streams import log_streams

    streams = log_streams(path)
    if streams:
        _print_streams(streams, path)
    whole = open_log(path, camera=camera)
    log = LogPart(whole, first_frame, None) if first_frame else whole
    print_table(describe_log(log), title=None if streams else path)
    if picture is not None:
        _write_picture(log, picture)
    return 0


def _describe_tiled(path: str, *, fit_plane: bool, picture: Path | None) -> int:
    from splatbot.cli.tiled import describe_tiles

    for name, given in (("--fit-plane", fit_plane), ("--picture", picture is not None)):
        if given:
            raise InputError("is not for a tiled map.", field=name, hint="give the map that it was made of")
    print_table(describe_tiles(Path(path)), title=path)
    return 0


def _print_streams(streams: Sequence[Stream], title: str) -> None:
    from rich.table import Table

    from splatbot.cli.tables import print_columns
    from splatbot.results.units import NONE

    table = Table(title=title, title_justify="left")
    columns = {
        "stream": [_printable(s.name) for s in streams],
        "kind": [_printable(s.kind) for s in streams],
        "messages": [str(s.count) for s in streams],
        "rate": [NONE if s.rate is None else f"{s.rate:.1f} Hz" for s in streams],
        "missing": [str(s.dropped) for s in streams],
        "repeated": [str(s.duplicates) for s in streams],
        "unordered": [str(s.out_of_order) for s in streams],
        "clock": [NONE if s.clock_offset is None else _clock(s.clock_offset) for s in streams],
        "first": [_printable(s.note) for s in streams],
    }
    shown = {name: values for name, values in columns.items() if set(values) - {"", NONE}}
    for name in shown:
        table.add_column(name, justify="left" if name in ("stream", "kind", "first") else "right")
    for row in zip(*shown.values(), strict=True):
        table.add_row(*row)
    print_columns(table)


def _printable(text: str) -> str:
    """Return a text of a recording without control characters and markup, which a terminal would obey."""
    from rich.markup import escape

    return escape("".join(letter if letter.isprintable() else "?" for letter in text))


def _clock(offset: float) -> str:
    return f"{1e3 * offset:+.1f} ms" if abs(offset) < 10.0 else f"{offset:+,.0f} s"


def _write_picture(log: Log, path: Path) -> None:
    """Write the first frame as PNG: colour, and depth from red (near) to blue (far)."""
    import cv2
    import numpy as np

    from splatbot.atomic import atomic_write
    from splatbot.rasterize.views import colorize

    frame = log[0]
    image = np.hstack([frame.rgb, colorize(frame.depth, "depth")])
    with atomic_write(path) as file:
        file.write(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
    print(f"written: {path}")


def describe_map(path: Path) -> list[tuple[str, str]]:
    """Describe a map file as names and values.

    Raises:
        FormatError: the file is damaged or of an unknown format.
    """
    import numpy as np

    from splatbot.gaussians import GaussianModel
    from splatbot.gaussians.surfels import holds_surfels
    from splatbot.results.units import count, megabytes

    model = GaussianModel.load(path)
    rows = [
        ("surfels" if holds_surfels(model) else "Gaussians", count(len(model))),
        ("SH degree", str(model.sh_degree)),
        ("file", megabytes(path.stat().st_size)),
        ("in memory", megabytes(model.nbytes)),
    ]
    if not len(model):
        return rows
    low, high = model.means.amin(0).tolist(), model.means.amax(0).tolist()
    rows += [(f"{axis} [m]", f"{a:.3f} to {b:.3f}") for axis, a, b in zip("xyz", low, high, strict=True)]
    widest = 1e3 * model.scales.amax(1)
    for name, values, unit in (("opacity", model.opacities, ""), ("largest scale", widest, " mm")):
        p5, p50, p95 = np.percentile(values.numpy(), (5, 50, 95))
        rows.append((f"{name} p5, p50, p95", f"{p5:.3g}, {p50:.3g}, {p95:.3g}{unit}"))
    return rows


def describe_log(log: Log) -> list[tuple[str, str]]:
    """Describe a log as names and values.

    Raises:
        LogError: a decoded frame is damaged.
    """
    import numpy as np

    from splatbot.evaluation import depth_offset
    from splatbot.results.units import NONE, metres, percent

    n = len(log)
    picks = sorted({round(i) for i in np.linspace(0, n - 1, min(n, CONSTANTS.samples))})
    frames = [log[i] for i in picks]
    duration = frames[-1].stamp - frames[0].stamp
    depths = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    near, middle, far = (float(v) for v in np.percentile(depths, (2, 50, 98))) if depths.size else (None,) * 3
    c, truth = log.camera, log.ground_truth
    length = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum()) if truth is not None else None
    return [
        ("frames", str(n)),
        *_cameras_of(log),
        ("duration", f"{duration:.2f} s"),
        ("rate", f"{(n - 1) / duration:.1f} Hz" if duration > 0 else NONE),
        ("image", f"{c.width}x{c.height}"),
        ("fx, fy, cx, cy", f"{c.fx:.2f}, {c.fy:.2f}, {c.cx:.2f}, {c.cy:.2f}"),
        ("depth p2, p50, p98", f"{metres(near)}, {metres(middle)}, {metres(far)}"),
        ("valid depth", percent(depths.size / sum(frame.depth.size for frame in frames))),
        ("shift of depth onto colour", shift_text(depth_offset(frames), c.width)),
        ("reference poses", f"{len(truth)}, path {metres(length)}" if truth is not None else "none"),
        *(("question", doubt) for doubt in camera_doubts(c)),
        *(("simulated effect", f"{effect['name']} ({effect['why']})") for effect in log.effects),
    ]


def _cameras_of(log: Log) -> list[tuple[str, str]]:
    """Return a row for each camera of a rig: frames, size and the kind of its pose."""
    from splatbot.config import Config, with_cameras
    from splatbot.logs.rig import RigLog

    if not isinstance(log, RigLog):
        return []
    cameras, rows = with_cameras(Config(), log.cameras, file=log.uri).cameras, []
    for part in log.parts:
        c, settings = part.log.camera, cameras.get(part.name)
        kind = "first" if settings is None else settings.kind
        rows.append((f"camera {part.name}", f"{kind}, {len(part.log)} frames, {c.width}x{c.height}"))
    return rows


def shift_text(shift: tuple[int, int] | None, width: int) -> str:
    """Describe the registration of depth to colour of ``width`` [px]. If the shift is None, it is unknown."""
    if shift is None:
        return "not known: few frames or edges, or none that depth and colour share clearly"
    text = f"{shift[0]}, {shift[1]} px"
    return f"{text}: not well registered" if max(map(abs, shift)) > CONSTANTS.max_shift * width else text
