"""`splatbot grasp`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatbot.cli.paths import check_file, result_folder, written_to
from splatbot.cli.placing import Pose, agree_with_plans, base_pose, margin_value, named_robot, run_folder
from splatbot.errors import InputError, SplatbotError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatbot.grasping.affordance import Hint, ObservedView, Target
    from splatbot.grasping.sampler import GraspSampler
    from splatbot.grasping.types import GraspResult
    from splatbot.robots.graspable_objects import GraspableObjects
    from splatbot.segmentation import SegmentedMap


def grasp(
    *,
    map: Annotated[Path, tyro.conf.arg(metavar="MAP")],
    target: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    pixel: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="U V")] = None,
    point: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None,
    box: Annotated[tuple[float, float, float, float] | None, tyro.conf.arg(metavar="U0 V0 U1 V1")] = None,
    mask: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PNG ...")] = (),
    tag: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    vlm: bool = False,
    index: Annotated[tuple[int, ...], tyro.conf.arg(metavar="I ...")] = (0,),
    robot: str = "panda",
    base: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    hand_only: bool = False,
    approach: Literal["any", "top", "side"] = "any",
    min_confidence: float = 0.5,
    accept_implied: bool = False,
    friction: float = 0.5,
    samples: int = 400,
    wanted: int = 10,
    pregrasp: float = 0.10,
    margin: Annotated[str | None, tyro.conf.arg(metavar="M|auto")] = None,
    unknown: Literal["free", "cautious", "occupied"] = "free",
    n_sigma: float = 1.0,
    min_observations: int = 1,
    seed: int = 0,
    verbose: bool = False,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    overwrite: bool = False,
) -> int:
    """Find grasps of an object in a map, best first, with each term of their scores.

    A name, a mark in an image of the run, or a point in the world selects the object. Names are rules on the names of
    the scene.yaml, colours, shapes, sizes and positions; ambiguous names are refused. Writes grasp.json and grasp.png.

    Examples:
        splatbot grasp --map runs/latest --target "largest box"
        splatbot grasp --map runs/latest --target "red cup" --approach top
        splatbot grasp --map runs/latest --pixel 320 210 --index 12
        splatbot grasp --map runs/latest --box 280 180 360 260 --index 12
        splatbot grasp --map runs/latest --mask a.png b.png c.png --index 0 20 40
        SPLATBOT_VLM_URL=http://127.0.0.1:8000/v1 SPLATBOT_VLM_MODEL=qwen splatbot grasp --map runs/a --target mug --vlm
        splatbot grasp --map map.ply --base 0 0.4 0 0.7071 -0.7071 0 0 --point 0.1 0.2 0.6 --hand-only

    Args:
        map: a run folder, or a map file.
        target: name or description of the object.
        pixel: pixel in an image of the run.
        point: position on or in the object, in the frame of the map [m].
        box: corners of a rectangle in an image of the run [px].
        mask: image of the same size that is not black at the object. Several masks, each in another image, separate
            objects that touch, as in a bin.
        tag: number of an AprilTag 36h11 on the object.
        vlm: also query the vision-language model of SPLATBOT_VLM_URL and SPLATBOT_VLM_MODEL; it and the rules must not
            contradict each other.
        index: index of the image in the run, from 0, for each mask.
        robot: its name, as of `splatbot robot list`.
        base: pose of the robot's base in the map; by default that of the scene.yaml next to the map (see
            `splatbot info --fit-plane`).
        hand_only: ignore the arm and its reachability.
        approach: direction of the approach.
        min_confidence: least probability of success 0..1 of a grasp, as simulated trials calibrate it.
        accept_implied: offer grasps of which no contact is at measured depth, or whose finger enters unseen space; such
            sides follow from the visible ones.
        friction: friction coefficient between finger pads and object.
        samples: sampled surface points, which determine the time. Without a result, four times as many are tried.
        wanted: largest number of grasps.
        pregrasp: shortest straight approach [m]. It is longer where no plan may end at its start, up to 0.3 m.
        margin: clearance [m] of hand and arm to the rest of the map. "auto", the default with a run, is the audited
            error of the map around the target, for the arm alone: the hand has to come close, and is checked against
            raw depth.
        unknown: space that no frame of the run saw to be empty, as in `splatbot plan`. Arm and hand avoid it at the
            pre-grasp, and the arm on the approach; --accept-implied decides on fingers there.
        n_sigma: surface of a Gaussian, in standard deviations; smaller than for planning, because the hand comes close.
        min_observations: least number of keyframes that support a Gaussian; others are ignored. A surface that few
            keyframes observed is then no obstacle for the arm either.
        seed: seed of the search.
        verbose: print the terms of the scores; without a grasp, the counts of each reason.
        out: folder to write to; by default runs/grasp, whose earlier results are replaced.
        overwrite: replace the results of an earlier call in the folder that --out names.
    """
    places = {"--target": target, "--pixel": pixel, "--point": point, "--box": box, "--mask": mask, "--tag": tag}
    given = [flag for flag, value in places.items() if value not in (None, ())]
    if len(given) != 1:
        raise InputError(f"are {len(given)}.", field=", ".join(places), hint="give one of them")
    if vlm and target is None:
        raise InputError("needs a name.", field="--vlm", hint="give --target too")
    map_file(map)
    for path in mask:
        check_file(path, "--mask")
    if len(index) != max(len(mask), 1):
        raise InputError(f"are {len(index)} for {max(len(mask), 1)}.", field="--index", hint="give one for each mask")
    folder, replaced = result_folder(out, "grasp", "grasp.json", "grasp.png", overwrite=overwrite)
    named = named_robot(robot)

    from splatbot.atomic import atomic_write
    from splatbot.cli.affordances import name_backends
    from splatbot.cli.progress import steps
    from splatbot.cli.tables import print_command, print_text
    from splatbot.grasping.advice import first_change
    from splatbot.grasping.affordance import find_target
    from splatbot.grasping.grasp_file import grasp_file
    from splatbot.grasping.object_list import stroke_of
    from splatbot.grasping.options import GraspOptions
    from splatbot.grasping.spatial import SpatialAffordance
    from splatbot.grasping.tags import TagAffordance
    from splatbot.report.grasp_view import grasp_png
    from splatbot.robots.appearance import appearance
    from splatbot.robots.joint_offsets import robot_in_scene
    from splatbot.workspace import find_workspace

    options = GraspOptions(
        friction=friction,
        samples=samples,
        pregrasp=pregrasp,
        wanted=wanted,
        approach=approach,
        min_confidence=min_confidence,
        accept_implied=accept_implied,
        seed=seed,
    )
    arm = robot_in_scene(named, find_workspace(map))
    with steps() as tell:
        tell("segmenting the objects of the map")
        objects = graspable_objects(map, base)
        scene = objects.scene
        hint = _hint(map, index, target=target, pixel=pixel, point=point, box=box, mask=mask, tag=tag)
        found = find_target(hint, scene, [*name_backends(vlm=vlm), SpatialAffordance(), TagAffordance()])
        sampler = objects.sampler(arm, hand_only=hand_only, n_sigma=n_sigma, min_observations=min_observations)
        tell("auditing the error of the map")
        audited, margin_text = _set_margin(sampler, "0" if hand_only and margin is None else margin, map, found)
        if not hand_only:
            tell("collecting the obstacles of plans")
            agree_with_plans(sampler, map, arm, arm.home, unknown, measured=audited)
        tell(f"searching for grasps of {found.label}")
        result = objects.with_notes(sampler.sample(found, options))
    failure = None if result.grasps else first_change(result, scene, stroke_of(arm), samples)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(folder / "grasp.json") as handle:
        content = grasp_file(
            result,
            sampler,
            map_file(map),
            robot=arm.name,
            joint_offsets=arm.joint_offsets,
            unknown=unknown,
            measured=audited and not hand_only,
            failure=failure,
        )
        handle.write(json.dumps(content, indent=2).encode())
    shown = next(iter((*result.grasps, *result.doubtful)), result.best_rejected)
    if shown is None:
        (folder / "grasp.png").unlink(missing_ok=True)  # of an earlier search
    else:
        with atomic_write(folder / "grasp.png") as handle:
            hand = [part for part in appearance(arm, shown.opening) if part.link == len(arm)]
            handle.write(grasp_png(scene, found.rows, shown, hand, arm.T_link_tcp))
    if failure is not None:
        print_text(f"written to {written_to(folder, replaced)}: grasp.json has the reasons of all candidates")
    if failure is not None and not verbose:
        reason, change = failure
        why = " ".join(note for note in found.notes if note.startswith("took "))
        what = f"{found.label} ({_place(found, scene)})"
        raise SplatbotError(f"cannot be grasped by {arm.name}: {reason}. {why}".strip(), field=what, hint=change)
    result.unwrap()
    _print(arm.name, result, scene, written_to(folder, replaced), margin_text, verbose=verbose)
    if not hand_only:
        print_command(f"splatbot plan-pick --map {map} --grasp {folder / 'grasp.json'} --start home")
    return 0


def graspable_objects(map_: Path, base: Pose | None) -> GraspableObjects:
    """Segment the objects of a run's map or of a map file.

    Raises:
        InputError: the base is not known.
        FormatError: the map or its run is damaged.
    """
    from splatbot.gaussians import GaussianModel, Snapshot
    from splatbot.robots.graspable_objects import measured_map, run_of, segment_objects
    from splatbot.workspace import find_workspace

    T = base_pose(base, map_)
    model = GaussianModel.load(map_file(map_))
    measured = measured_map(Snapshot(model, map_version=0), run_of(map_))
    return segment_objects(measured, T, find_workspace(map_), as_known=base is None)


def _hint(
    map_: Path,
    index: tuple[int, ...],
    *,
    target: str | None,
    pixel: tuple[float, float] | None,
    point: tuple[float, float, float] | None,
    box: tuple[float, float, float, float] | None,
    mask: tuple[Path, ...],
    tag: int | None,
) -> Hint:
    import numpy as np

    from splatbot.grasping.affordance import BoxHint, MaskHint, MasksHint, NameHint, PixelHint, PointHint, TagHint

    if target is not None:
        return NameHint(target)
    if point is not None:
        return PointHint(np.array(point))
    views = _views(map_, index)
    if len(mask) > 1:
        return MasksHint(tuple(MaskHint(_read_mask(path), view) for path, view in zip(mask, views, strict=True)))
    view = views[0]
    if pixel is not None:
        return PixelHint(*pixel, view)
    if box is not None:
        return BoxHint(*box, view)
    if mask:
        return MaskHint(_read_mask(mask[0]), view)
    assert tag is not None
    return TagHint(tag, (view,))


def _read_mask(path: Path) -> NDArray[np.bool_]:
    import cv2
    import numpy as np

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if picture is None:
        raise InputError("cannot be read.", file=path, field="--mask", hint="give a PNG of the size of the image")
    return np.asarray(picture.reshape(*picture.shape[:2], -1).any(axis=2))


def _views(map_: Path, indices: tuple[int, ...]) -> list[ObservedView]:
    import numpy as np

    from splatbot.grasping.affordance import ObservedView
    from splatbot.results.folder import RunFolder
    from splatbot.results.views import rectified_log
    from splatbot.robots.in_view import reopen_log

    if not map_.is_dir():
        raise InputError("has no images.", file=map_, hint="give the folder of a run, or --target or --point")
    run = RunFolder(map_)
    poses = run.load_poses()
    log = reopen_log(run)
    views = []
    mapped = rectified_log(run, log) if len(indices) > 1 else None  # its depth is compared with several masks
    for index in indices:
        if index not in poses:
            hint = f"one of {min(poses)}..{max(poses)} that has"
            raise InputError(f"is {index}, which has no pose.", field="--index", hint=hint)
        depth = None
        if mapped is not None:
            frame = mapped[index]
            depth = np.where(frame.valid, frame.depth, np.float32(0))
        seen = log[index]
        views.append(ObservedView(seen.camera.pinhole, poses[index], seen.rgb, depth))
    return views


def _audited(map_: Path, sampler: GraspSampler, target: Target) -> float:
    """Return the audited error of the map around a target [m]."""
    from splatbot.results.margin import CONSTANTS, audited_error
    from splatbot.robots.in_view import reopen_log

    error = audited_error(map_, reopen_log(run_folder(map_, "--margin auto")), sampler.field)
    means = sampler.scene.model.means.detach().double().numpy()
    return error.in_region(means[target.rows]).quantile(CONSTANTS.confidence)


def _set_margin(sampler: GraspSampler, margin: str | None, map_: Path, target: Target) -> tuple[bool, str]:
    """Set the margin of a search; return whether it is audited, and its scope in words.

    Raises:
        SplatbotError: the margin is "auto", and the map has no recording that can be read.
    """
    hand = "the hand clears measured depth" if sampler.raw is not None else "no run with depth checks the hand"
    if margin == "auto" or (margin is None and map_.is_dir()):
        try:
            sampler.arm_margin = _audited(map_, sampler, target)
        except SplatbotError as error:
            if margin == "auto":
                raise
            return False, f"0, because the recording cannot be audited ({error.message}); {hand}"
        return True, f"arm {1e3 * sampler.arm_margin:.1f} mm, the error of the map around the target; {hand}"
    sampler.margin = margin_value(margin or "0")
    if sampler.margin > 0.0:
        return False, f"{1e3 * sampler.margin:.1f} mm for arm and hand; {hand}"
    return False, f"0, so that errors of the map are not covered; {hand}"


def _place(target: Target, scene: SegmentedMap) -> str:
    """Describe the size of a target, if it is a whole object, and the middle of its bounding box from the base."""
    from splatbot.planning.problem import place_words

    points = scene.points[target.rows]
    known = scene.objects[target.number] if 0 <= target.number < len(scene.objects) else None
    whole = known is not None and len(known.rows) == len(points)
    size = "×".join(f"{1e3 * x:.0f}" for x in known.size) + " mm, " if known is not None and whole else ""
    return f"{size}at {place_words((points.min(axis=0) + points.max(axis=0)) / 2)}"


def _print(robot: str, result: GraspResult, scene: SegmentedMap, folder: str, margin: str, *, verbose: bool) -> None:
    from rich.table import Table

    from splatbot.cli.tables import print_columns, print_table, print_text

    target = result.target
    taken = f"{target.label}, {len(target.rows)} Gaussians, by {target.backend} ({target.score:.2f})"
    seconds = sum(result.seconds.values())
    rows = [
        ("target", f"{taken}; {_place(target, scene)}"),
        ("robot", robot),
        ("candidates", f"{result.candidates} hands in {1e3 * seconds:.0f} ms"),
        *(("note", note) for note in (*target.notes, *result.notes)),
        ("margin", margin),
        ("written to", f"{folder}: grasp.json has poses, joint values and terms; grasp.png shows the first"),
    ]
    print_table(rows, title="grasps")
    terms = list(result.grasps[0].terms) if verbose else []
    contacts = ["contacts"] if result.grasps[0].implied else []
    table = Table()
    lifts = ["lift"] if any(g.lift_blocked for g in result.grasps) else []
    for name in ("grasp", "total", "conf.", "from", "width", "opens", "clear", *lifts, *contacts, *terms):
        table.add_column(name, justify="left" if name == "from" else "right")
    for k, g in enumerate(result.grasps):
        lengths = (f"{1e3 * value:.1f}" for value in (g.width, g.opening, g.clearance))
        contact = [" and ".join("implied" if each else "measured" for each in g.implied)] if contacts else []
        lift = ["no" if g.lift_blocked else "yes"] if lifts else []
        values = (f"{g.terms[name]:.2f}" for name in terms)
        table.add_row(str(k), f"{g.total:.3f}", f"{g.confidence:.2f}", g.approach, *lengths, *lift, *contact, *values)
    print_columns(table)
    print_text("grasp: its rank from 0, as plan and plan-pick take it (--grasp-index)")
    print_text("from: above (top, within 40 degrees), level away from the robot (front), level (side), else (free)")
    print_text("width of the closed hand, opening on the approach, and clearance from the surroundings, in mm")
    print_text("the best total is 1; --verbose prints its terms, of which the best value is 1")
    print_text("conf.: share of such grasps that succeeded in simulation; errors of the map are not in it")
    if lifts:
        print_text("lift: whether 15 cm straight up with the object are certified, as plan-pick requires")
    if contacts:
        print_text("a measured contact is within 3 mm of depth that three frames agree on; an implied one is not")
        if any(g.implied and any(g.implied) for g in result.grasps):
            print_text(
                "warning: an implied side may be elsewhere, and conf. does not cover that; map it from there first"
            )
