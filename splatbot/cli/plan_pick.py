"""`splatbot plan-pick`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.drawing import CAMERA, draw_offscreen, film
from splatbot.cli.grasp import graspable_objects
from splatbot.cli.paths import check_file, check_output, result_folder, written_to
from splatbot.cli.placing import (
    PROPOSED_BASE,
    Pose,
    agree_with_plans,
    is_base_proposed,
    joint_values,
    pose_values,
    robot_of_grasps,
)
from splatbot.errors import SplatbotError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.grasping.grasp_file import GraspFile
    from splatbot.sim.map_pick import MapPick
    from splatbot.sim.scene import Scene


def plan_pick(
    *,
    map: Annotated[Path, tyro.conf.arg(metavar="MAP")],
    grasp: Annotated[Path, tyro.conf.arg(metavar="JSON")],
    start: Annotated[tuple[str, ...], tyro.conf.arg(metavar="Q ...")] = ("home",),
    grasp_index: int | None = None,
    lift: float = 0.15,
    speed: float = 0.2,
    slow: float = 0.3,
    force: Annotated[float | None, tyro.conf.arg(metavar="NEWTONS")] = None,
    tries: int = 5,
    budget_ms: float = 500.0,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    seed: int = 0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    overwrite: bool = False,
) -> int:
    """Plan a complete pick in a map, and simulate it in the twin of the map before the robot moves.

    The pick is: open, move to the pre-grasp, approach in a straight line, close, lift. Each motion is certified as it
    will be executed, with the fingers at their opening and the object in the hand. The twin then executes the pick with
    contacts and friction. The exit code is 1 unless the object is held and nothing else was touched.

    Writes one JointTrajectory for each motion (1-move.json, 2-approach.json and so on). pick.json has their order and
    the finger openings; pick.html animates the simulation.

    Examples:
        splatbot plan-pick --map runs/latest --grasp runs/grasp/grasp.json
        splatbot plan-pick --map runs/latest --grasp runs/grasp/grasp.json --grasp-index 2 --speed 0.1 --video pick.mp4

    Args:
        map: a run folder, or a map file.
        grasp: file of `splatbot grasp`; its robot, base, margins and treatment of unknown space apply.
        start: joint values [rad or m], or "home".
        grasp_index: rank of the grasp in that file, from 0; by default the first that can be planned.
        lift: height of the lift [m].
        speed: fraction of the limits of velocity and acceleration.
        slow: additional factor on the speed of approach and lift.
        force: force of the fingers; by default the gripper's own.
        tries: largest number of grasps to plan for.
        budget_ms: time budget of the planner for the way to each pre-grasp [ms].
        video: MP4 of the simulation.
        seed: seed of the planner, and of small displacements of the object in the twin; 0 for none.
        out: folder to write to; by default runs/pick, whose earlier results are replaced.
        overwrite: replace the results of an earlier call in the folder that --out names.
    """
    file = map_file(map)
    check_file(grasp, "--grasp")
    folder, replaced = result_folder(out, "pick", "pick.json", "pick.html", overwrite=overwrite)
    check_output(video, "--video", folder=False)
    if video is not None:
        draw_offscreen()
    named = robot_of_grasps(grasp)
    joint_values(start, named, "--start")

    from splatbot.atomic import replace_files, write_text
    from splatbot.cli.progress import steps
    from splatbot.grasping.grasp_file import GraspFile
    from splatbot.grasping.pick_types import PickOptions
    from splatbot.robots.joint_offsets import robot_in_scene
    from splatbot.sim.map_pick import TARGET, pick_on_map, twin_of_pick
    from splatbot.sim.page import recording_html
    from splatbot.workspace import find_workspace

    options = PickOptions(
        lift=lift, speed=speed, slow=slow, force=force, tries=tries, budget_ms=budget_ms, attempts=1, seed=seed
    )
    known = GraspFile.load(grasp)
    robot = robot_in_scene(named, find_workspace(map))
    known.check_offsets(robot.joint_offsets)
    grasps = known.result(grasp_index, len(robot))
    here = joint_values(start, robot, "--start")
    known.check_map(file)
    with steps() as tell:
        tell("segmenting the objects of the map")
        objects = graspable_objects(map, _base(map, known))
        known.check_rows(len(objects.scene.model))
        sampler = objects.sampler(robot, n_sigma=known.n_sigma, min_observations=known.min_observations)
        sampler.margin, sampler.arm_margin = known.margin, known.arm_margin
        tell("collecting the obstacles of plans")
        agree_with_plans(sampler, map, robot, here, known.unknown, measured=known.measured)
        tell("planning and simulating the pick")
        scene = _scene(map, known, with_camera=video is not None)
        twin = twin_of_pick(scene, robot, sampler, known.target, seed=seed)
        with film(video, twin.world, seed) as watch:
            picked = pick_on_map(
                twin, sampler, known.target, grasps, options, start=here,
                on_step=lambda step: tell(f"simulating the pick: {step.stage} is done"), watch=watch,
            )  # fmt: skip
    proposed = is_base_proposed(_base(map, known), map)
    texts = {"pick.json": json.dumps(_summary(picked, known) | {"base_proposed": proposed}, indent=2)}
    for name, motion in zip(_names(picked), picked.result.motions, strict=True):
        texts[name] = motion.trajectory.to_json()
    title = f"{known.target.label} in {map.resolve().name}"
    facts = f"in simulation: {_verdict(picked)}; {ARM_CLEARANCE} at least {1e3 * picked.clearance.value:.1f} mm"
    texts["pick.html"] = recording_html(picked.recording, title=title, facts=facts, target=TARGET)
    replace_files(folder, {name: write_text(text) for name, text in texts.items()})
    for path in folder.glob("[0-9]-*.json"):
        if path.name not in texts:  # a motion of an earlier pick must not follow these
            path.unlink()
    _print(picked, known, written_to(folder, replaced), proposed=proposed)
    if not picked:
        first = picked.problems[0].split("; ")[0].rstrip(".")  # the table has all of them
        raise SplatbotError(f"should not be executed: {first}.", field="pick", hint=_HINT)
    return 0


ARM_CLEARANCE = "clearance of the arm without its hand"
"""Name of the clearance of the links before the hand, which comes close to the target on purpose."""
_HINT = (
    "try another grasp (`--grasp-index`), mark the target alone where objects touch (`splatbot grasp --mask`), "
    "or map the scene from more sides"
)


def _base(map_: Path, known: GraspFile) -> Pose | None:
    """Return the base of the grasps as a flag's value, or None if it is that of the scene.yaml."""
    import numpy as np

    from splatbot.workspace import find_workspace

    workspace = find_workspace(map_)
    placed = None if workspace is None else workspace.T_world_base
    if placed is not None and np.allclose(placed, known.T_world_base, rtol=0.0, atol=1e-6):
        return None
    pose = pose_values(known.T_world_base)
    x, y, z = pose["translation"]
    return (x, y, z, *pose["quaternion_wxyz"])  # type: ignore[return-value]


def _scene(map_: Path, known: GraspFile, *, with_camera: bool) -> Scene:
    from splatbot.sim.maps.placed import placed_scene
    from splatbot.sim.scene import make_scene

    values = placed_scene(map_, T_world_base=known.T_world_base)
    if with_camera:
        values["camera"] = CAMERA
    return make_scene(values)


def _names(picked: MapPick) -> list[str]:
    return [f"{number}-{motion.stage}.json" for number, motion in enumerate(picked.result.motions, start=1)]


def _summary(picked: MapPick, known: GraspFile) -> dict[str, Any]:
    from dataclasses import asdict

    result = picked.result
    return {
        "robot": known.robot,
        "joint_offsets": known.joint_offsets.tolist(),
        "T_world_base": pose_values(known.T_world_base),
        "target": known.target.label,
        "execute": bool(picked),
        "problems": list(picked.problems),
        "motions": [
            {
                "stage": motion.stage,
                "file": name,
                "duration_s": motion.trajectory.duration,
                "opening_m": motion.opening,
                "certified": motion.trajectory.certificate.certified,
                "clearance_m": motion.trajectory.certificate.clearance,
                "margin_m": motion.trajectory.certificate.margin,
            }
            for name, motion in zip(_names(picked), result.motions, strict=True)
        ],
        "stages": [{"stage": step.stage, "note": step.note} for step in result.steps],
        "arm_margin_m": known.arm_margin,
        "grasp_width_m": None if result.grasp is None else result.grasp.width,
        "simulated": {
            "outcome": picked.outcome,
            "reason": "; ".join(picked.problems),
            "rose_m": picked.rose,
            "contacts": [asdict(contact) for contact in picked.contacts],
            "clearance": asdict(picked.clearance),
            "notes": list(picked.notes),
        },
    }


def _verdict(picked: MapPick) -> str:
    if picked:
        return f"held, and risen by {1e3 * picked.rose:.0f} mm; the arm touched nothing else"
    return "; ".join(picked.problems)


def _print(picked: MapPick, known: GraspFile, folder: str, *, proposed: bool) -> None:
    from splatbot.cli.tables import print_table, print_text
    from splatbot.planning.timing import clearance_text

    result, near = picked.result, picked.clearance
    rows = [(str(step.stage), step.note) for step in result.steps]
    for name, motion in zip(_names(picked), result.motions, strict=True):
        length, opening = f"{motion.trajectory.duration:.1f} s", f"{1e3 * motion.opening:.0f} mm open"
        clearance = clearance_text(motion.trajectory.certificate)
        rows.append((name.removesuffix(".json"), f"{length}, {opening}, clearance {clearance}"))
    rows.append(("margin", f"{1e3 * known.arm_margin:.1f} mm before the hand, {1e3 * known.margin:.1f} mm at the hand"))
    if proposed:
        rows.append(("base", PROPOSED_BASE))
    rows.append(("verdict", _verdict(picked) if result else str(result.outcome)))  # a row above has the reason
    if near.part:
        where = f"{picked.words(near.part)} and {near.other} at {near.time:.1f} s"
        rows.append(("nearest in the twin", f"{ARM_CLEARANCE} {1e3 * near.value:.1f} mm: {where}"))
    print_table([*rows, ("written to", folder)], title=f"pick of {known.target.label}")
    print_text("the twin assumes 0.2 kg, a friction coefficient of 0.8, and the completed shape of the target")
