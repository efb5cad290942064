"""`splatbot info --fit-plane`: the support plane and a robot's base, decided or estimated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatbot.cli.placing import PROPOSED_BASE
from splatbot.cli.tables import print_table, print_text

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.protocols import Array
    from splatbot.up_direction import WorkspaceEstimate
    from splatbot.workspace import Workspace

Up = tuple[float, float, float]


def fit_plane(map_file: Path, up: Up | None, support: int | None, base_offset: Up | None) -> int:
    """Describe the workspace next to a map, or estimate and write it with a picture; return the exit code.

    ``up`` overrides an existing scene.yaml. An estimate with doubts is not written. ``support`` proposes the base on
    another support of the segmented map, and ``base_offset`` (3,) [m] moves it along its own axes.

    Raises:
        InputError: the map has no upward surface, or no such support.
        FormatError: the map or a scene.yaml is damaged.
    """
    from splatbot.gaussians import GaussianModel
    from splatbot.workspace import NAME, find_workspace

    target = map_file.with_name(NAME)
    known = find_workspace(map_file)
    model = GaussianModel.load(map_file)
    notes: list[tuple[str, str]] = []
    if known is not None and up is None:
        place, how = known, "the file"
    else:
        found = _estimate(map_file, model, up)
        if found.doubts and up is None:
            _ask(found, map_file)
            _draw(model, found.workspace, map_file)
            return 1
        place, how = found.workspace if known is None else _with_support(known, found.workspace), found.decided_by
        notes = [("note", doubt) for doubt in found.doubts]
        if notes:
            notes.append(("note", f"the plane is used, because {found.decided_by} gives the direction"))
    if support is not None:
        if known is not None and known.T_world_base is not None and not known.base_proposed:
            notes.append(("note", f"the base before was at {_text(known.T_world_base[:3, 3])}, and was not a proposal"))
        proposed = _on_support(model, map_file.parent, place, support)
        place, how = _with_support(place, proposed), f"support {support} of the map"
    if base_offset is not None:
        place, how = place.with_base_moved(base_offset), f"{how}, with the base moved"
    if place is not known:
        place.save(target)
        how = f"{how}, {'replaced' if known is not None else 'written'}"
    print_table([("from", how), *_rows(place), *notes], title=str(target))
    _draw(model, place, map_file)
    return 0


def _with_support(known: Workspace, found: Workspace) -> Workspace:
    """Return a workspace with the plane, the base and the box of another one."""
    return replace(
        known,
        T_world_base=found.T_world_base,
        gravity=found.gravity,
        support_plane=found.support_plane,
        box=found.box,
        base_proposed=found.base_proposed,
    )


def _on_support(model: GaussianModel, folder: Path, place: Workspace, number: int) -> Workspace:
    """Propose a base on a support of the map, by its number in `splatbot objects`.

    Raises:
        InputError: the base is unknown, or the map has no such support.
    """
    import numpy as np

    from splatbot.errors import InputError
    from splatbot.gaussians import Snapshot
    from splatbot.robots.graspable_objects import measured_map, run_of, segment_objects
    from splatbot.workspace import workspace_on

    T = place.T_world_base
    if T is None:
        raise InputError("needs a base.", field="--support", hint="propose one first: --fit-plane --up X Y Z")
    measured = measured_map(Snapshot(model, map_version=0), run_of(folder))
    supports = segment_objects(measured, T, place, as_known=True).scene.supports
    if not 0 <= number < len(supports):
        heights = ", ".join(f"{k} at {1e3 * each.offset:+.0f} mm" for k, each in enumerate(supports))
        hint = f"heights above the base: {heights}" if supports else "give --up X Y Z"
        raise InputError(f"is {number}, of {len(supports)} supports.", field="--support", hint=hint)
    normal = T[:3, :3] @ supports[number].normal
    plane = np.array([*normal, -(supports[number].offset + normal @ T[:3, 3])])
    return workspace_on(plane, model.means.double().numpy())


def _estimate(map_file: Path, model: GaussianModel, up: Up | None) -> WorkspaceEstimate:
    from splatbot.up_direction import estimate_workspace

    if up is not None:
        return estimate_workspace(model, up)
    measured = _measured_up(map_file)
    if measured is not None:
        return estimate_workspace(model, measured, decided_by="accelerometer of the log")
    return estimate_workspace(model)


def _measured_up(map_file: Path) -> Up | None:
    """Return the up direction that the log's accelerometer measured, or None without one."""
    from splatbot.errors import SplatbotError
    from splatbot.logs.gravity import measured_up
    from splatbot.results.folder import RunFolder

    run = RunFolder(map_file.parent)
    try:
        uri = run.load_metrics().get("log", {}).get("uri")
        return None if uri is None else measured_up(str(uri), run.load_trajectory())
    except SplatbotError:  # a map without a run, or a run whose log is gone
        return None


def _ask(found: WorkspaceEstimate, map_file: Path) -> None:
    rows = [("doubt", doubt) for doubt in found.doubts]
    places = (found.workspace, *found.others)
    rows += [(f"candidate {number}", _candidate(place)) for number, place in enumerate(places, 1)]
    print_table(rows, title="the up direction is doubtful; nothing is written")
    print_text("say which is up in the first camera (x right, y down, z ahead), one of:")
    normals = [place.support_plane[:3] for place in places if place.support_plane is not None]
    for up in (*normals, *found.directions):
        x, y, z = (round(float(value), 3) + 0.0 for value in up)
        print(f"  splatbot info {map_file.parent} --fit-plane --up {x:g} {y:g} {z:g}")


def _candidate(place: Workspace) -> str:
    import numpy as np

    assert place.support_plane is not None
    pitch = float(np.degrees(np.arcsin(np.clip(-place.support_plane[2], -1.0, 1.0))))
    return f"{place.support_plane[3]:.3f} m below the first camera, which looks down by {pitch:.0f}°"


def _rows(found: Workspace) -> list[tuple[str, str]]:
    T = found.T_world_base
    proposed = f"; {PROPOSED_BASE}" if found.base_proposed else ""
    return [
        ("gravity", _text(found.gravity)),
        ("support plane n, d [m]", _text(found.support_plane)),
        ("base at [m]", _text(None if T is None else T[:3, 3]) + proposed),
        ("base's x, z", _text(None if T is None else T[:3, [0, 2]].T)),
        ("workspace, from the base [m]", _text(found.box)),
    ]


def _text(values: Array | None) -> str:
    return "not known" if values is None else " ".join(f"{x:.3f}" for x in values.ravel())


def _draw(model: GaussianModel, place: Workspace, map_file: Path) -> None:
    from splatbot.atomic import atomic_write
    from splatbot.report.workspace_view import workspace_png
    from splatbot.trajectory import Trajectory

    if place.T_world_base is None:
        return
    trajectory = map_file.with_name("trajectory.tum")
    path = Trajectory.load(trajectory).positions if trajectory.is_file() else None
    picture = map_file.with_name("scene.png")
    with atomic_write(picture) as file:
        file.write(workspace_png(model, place, path))
    print(f"picture: {picture}")
