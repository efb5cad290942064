"""`splatbot objects`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.paths import check_output
from splatbot.cli.placing import Pose, margin_value, named_robot, run_folder
from splatbot.cli.tables import print_columns, print_table, print_text
from splatbot.errors import SplatbotError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.grasping.object_list import ListedObject
    from splatbot.robots.graspable_objects import GraspableObjects


def objects(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|MAP")],
    /,
    *,
    robot: str = "panda",
    base: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    margin: Annotated[str | None, tyro.conf.arg(metavar="M|auto")] = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    out: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None,
) -> int:
    """List the supports and objects of a map with labels and sizes, so that a target can be named.

    Objects that stand on a support come first; the other clusters are often parts of the background. Pieces of walls,
    posts and tables are structure, which words as "largest box" never take. Writes a picture with the number of each
    object. `splatbot grasp --target "object 3"` takes an object of the list.

    Examples:
        splatbot objects runs/desk
        splatbot objects runs/desk --robot panda-2f140 --json
        splatbot objects runs/desk --margin 0
        splatbot objects map.ply --base 0 0.4 0 0.7071 -0.7071 0 0 --out objects.png

    Args:
        map: a run folder, or a map file.
        robot: robot whose hand must enclose an object and whose arm must reach it.
        base: pose of the robot's base in the map; by default that of the scene.yaml next to the map (see
            `splatbot info --fit-plane`).
        margin: clearance [m] of the arm before its hand to the map, where reach is checked. "auto", the default with a
            run, is the audited error of the map around the objects; the default of a map file is 0.
        as_json: print JSON, in which each length names its unit.
        out: the picture; by default objects.png next to the map.
    """
    file = map_file(map)
    picture = out if out is not None else file.with_name("objects.png")
    check_output(picture, folder=False)
    named = named_robot(robot)
    given = None if margin in (None, "auto") else margin_value(str(margin))
    if margin == "auto":
        run_folder(map, "--margin auto")

    from splatbot.atomic import atomic_write
    from splatbot.cli.grasp import graspable_objects
    from splatbot.cli.progress import steps
    from splatbot.grasping.object_list import list_planes, stroke_of
    from splatbot.report.objects_view import objects_png
    from splatbot.robots.joint_offsets import robot_in_scene
    from splatbot.workspace import find_workspace

    known = find_workspace(map)
    arm = robot_in_scene(named, known)
    with steps() as tell:
        tell("segmenting the objects of the map")
        objects = graspable_objects(map, base)
        scene = objects.scene
        kept, why = 0.0, "the robot has no hand"
        if stroke_of(arm) > 0.0:
            tell("auditing the error of the map")
            kept, why = (given, "as given") if given is not None else _audited(map, objects, required=margin == "auto")
            tell("checking the reach of the arm")
        found = objects.listed(arm, margin=kept, plane=None if known is None else known.support_plane)
        planes = list_planes(scene)
    with atomic_write(picture) as handle:
        handle.write(objects_png(scene, found))
    if as_json:
        values = {
            "planes": planes,
            "objects": [item.to_dict() for item in found],
            "hand_opens_m": stroke_of(arm),
            "arm_margin_m": kept,
        }
        print(json.dumps(values, indent=2))
        return 0
    _print(found, planes)
    if any(item.reach in ("yes", "blocked") for item in found):
        print_text(f"margin of the arm before its hand: {1e3 * kept:.1f} mm, {why}")
    print(f"picture: {picture}")
    return 0


def _audited(map_: Path, objects: GraspableObjects, *, required: bool) -> tuple[float, str]:
    """Return the audited error [m] of a run's map around its objects, with its source; 0 if it cannot be audited.

    Raises:
        SplatbotError: it is required, and the recording cannot be audited.
    """
    from splatbot.collision import GaussianCollisionField
    from splatbot.gaussians import GaussianModel
    from splatbot.results.margin import audited_error
    from splatbot.robots.in_view import reopen_log

    if not map_.is_dir():
        return 0.0, "because a map file has no recording"
    try:
        field = GaussianCollisionField(GaussianModel.load(map_file(map_)))
        error = audited_error(map_, reopen_log(run_folder(map_, "--margin auto")), field)
    except SplatbotError as failure:
        if required:
            raise
        return 0.0, f"because the recording cannot be audited ({failure.message})"
    return objects.error_around(error), "the error of the map around the objects"


def _print(found: tuple[ListedObject, ...], planes: list[dict[str, Any]]) -> None:
    from rich.table import Table

    rows = []
    for plane in planes:
        size = " x ".join(f"{x:.2f}" for x in plane["size_m"])
        rows.append((plane["label"], f"{size} m, {plane['height_base_m']:+.3f} m above the base"))
    print_table(rows, title="planes")
    for title, on_support in (("objects", True), ("clusters that stand on no support", False)):
        chosen = [item for item in found if item.on_support == on_support and not item.structure]
        if not chosen:
            continue
        table = Table("no.", "label", "size, mm", "at, m", "hand", "reach", title=title, title_justify="left")
        for item in chosen:
            table.add_row(str(item.number), item.label, _size(item), _place(item), *_verdicts(item))
        print_columns(table)
    structures = [item for item in found if item.structure]
    if structures:
        table = Table("no.", "size, mm", "at, m", "why", title="structure", title_justify="left")
        for item in structures:
            table.add_row(str(item.number), _size(item), _place(item), item.structure)
        print_columns(table)
        print_text("structure: no target; a name in scene.yaml makes a piece an object")
    print_text("no.: rank by the number of Gaussians, for this base and box of scene.yaml; others renumber them")
    print_text("at: the middle of the object from the base; size: long side, short side, height")
    targets = [item for item in found if not item.structure]
    for verdict in dict.fromkeys(word for item in targets for word in _verdicts(item) if word in _MEANINGS):
        print_text(f"{verdict}: {_MEANINGS[verdict]}")


def _size(item: ListedObject) -> str:
    return "×".join(f"{1e3 * x:.0f}" for x in item.size)


def _place(item: ListedObject) -> str:
    return " ".join(f"{x:.2f}" for x in item.at_base)


def _verdicts(item: ListedObject) -> tuple[str, str]:
    """Return the words for the hand and for the arm."""
    return item.of_hand.verdict if item.of_hand else "fits", item.reach or "-"


_MEANINGS = {
    "fits": "the hand encloses it by its size; splatbot grasp also checks its sides and surroundings",
    "yes": "a posture takes the tool to its centre, free of the map without it; from above, fingers may be in its "
    "support",
    "blocked": "each posture found for the tool at its centre meets the map or the arm; --json names the contact",
    "no hand": "the robot has no hand; --robot takes one that has",
    "too flat": "lower than 12 mm, so that no hand encloses it",
    "too wide": "its faces are farther apart than the hand opens, less 2 mm at each pad",
    "no pose": "no posture of the arm takes the tool to its centre from above, the front or a side",
    "too far": "beyond the reach of the arm from this base; --json has the distances",
}
