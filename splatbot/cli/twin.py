"""`splatbot twin`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.drawing import CAMERA, draw_offscreen, film
from splatbot.cli.loading import without_line
from splatbot.cli.paths import check_file, check_output
from splatbot.cli.placing import Pose, checked_pose, named_robot
from splatbot.errors import FormatError, InputError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.robots.robot import RobotModel
    from splatbot.sim.ledger import LedgerEntry
    from splatbot.sim.recording import TwinRecording
    from splatbot.sim.scene import Scene
    from splatbot.sim.twin import TwinResult


def twin(
    scene: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None,
    map: Annotated[Path | None, tyro.conf.arg(metavar="RUN|FILE")] = None,
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    base: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    trajectory: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    html: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    force: Annotated[tuple[str, ...], tyro.conf.arg(metavar="EFFECT"), tyro.conf.UseAppendAction] = (),
    forbid: Annotated[tuple[str, ...], tyro.conf.arg(metavar="EFFECT"), tyro.conf.UseAppendAction] = (),
    timestep: Annotated[float | None, tyro.conf.arg(metavar="S")] = None,
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    no_costs: bool = False,
    list_: Annotated[bool, tyro.conf.arg(name="list")] = False,
    quiet: bool = False,
) -> int:
    """Simulate a motion in the physics of a scene before the robot moves.

    The output begins with the verdict, and reports tracking error, contacts, clearance and dropped objects. It ends
    with the active physics effects, their reasons and costs; only effects that the scene needs are active. The exit
    code is 1 after an unintended contact.

    Examples:
        splatbot twin --list
        splatbot twin --scene mug_hanging --video mug.mp4 --html mug.html
        splatbot twin --scene wiping --forbid backlash --json result.json
        splatbot twin --map runs/latest --trajectory runs/plan/trajectory.json
        splatbot twin --map runs/latest --robot ur5e-2f85 --trajectory runs/plan/trajectory.json --video ur5e.mp4
        splatbot twin --map map.ply --base 0 0.4 0 0.7071 -0.7071 0 0 --trajectory runs/plan/trajectory.json
        splatbot twin --scene my_scene.yaml --seed 3

    Args:
        scene: a shipped scene (--list) or a YAML file.
        map: a run's folder or a Gaussian map: table, objects, clutter are fitted. The scene.yaml next to it defines
            the base of the robot. Without one, the map is in the robot's frame (z up, base at the origin).
        robot: its name, as of `splatbot robot list`; by default that of the scene, or the Panda in a map.
        base: pose of the robot's base in the map; by default that of the scene.yaml next to the map.
        trajectory: ROS JointTrajectory as JSON, or CSV; by default the moves of the scene's task.
        json: file for the whole result.
        video: MP4 of the scene's camera.
        html: interactive page of the run.
        force: effect of physics or of the sensor to activate in any case; repeat it for several.
        forbid: effect to deactivate; repeat it for several.
        timestep: longest step of physics [s].
        seed: seed of the camera's noise and of millimetre offsets of movable objects; 0 uses no offsets.
        no_costs: do not measure the cost of each effect (one run for each).
        list_: print the scenes and the physics and leave.
        quiet: print only errors.
    """
    if video is not None:
        draw_offscreen()
    if list_:
        _print_lists()
        return 0
    if (scene is None) == (map is None):
        raise InputError(
            "needs either a scene or a map.", field="--scene", hint="splatbot twin --list names the scenes"
        )
    if map is not None:
        map_file(map)
    elif base is not None:
        raise InputError("places a robot in a map.", field="--base", hint="give --map, or `at` in the scene's file")
    check_file(trajectory, "--trajectory")
    for flag, path in (("--json", json), ("--video", video), ("--html", html)):
        check_output(path, flag, folder=False)
    arm = None if robot is None else named_robot(robot)

    from splatbot.robots.joint_offsets import robot_in_scene
    from splatbot.sim.ledger import ledger
    from splatbot.sim.motion import load_motion
    from splatbot.sim.recording import TwinRecording
    from splatbot.sim.twin import Twin
    from splatbot.workspace import find_workspace

    chosen = _scene(scene, map, base, with_camera=video is not None).with_effects(force=force, forbid=forbid)
    if map is not None and chosen.robot is not None:
        arm = robot_in_scene(arm or named_robot(chosen.robot.model), find_workspace(map))
    it = Twin(chosen, robot=arm, timestep=timestep, seed=seed)
    motion = None
    if trajectory is not None and it.world.robot is not None:
        motion = load_motion(trajectory, it.world.robot)
        if map is not None:
            _check_offsets(trajectory, it.world.robot)
    with film(video, it.world, seed) as shown, _progress(quiet) as show:
        recording = TwinRecording(it.world) if html is not None else None
        result = it.follow(motion, progress=show, watch=_watchers(shown, recording))
        sensor = shown.report() if shown is not None else []
    entries = ledger(it, result, motion, costs=not no_costs, sensor=sensor)
    harm = _harm(chosen, result)
    if json is not None:
        _write(json, result, entries, sensor)
    if html is not None and recording is not None:
        _write_page(html, recording, result)
    if not quiet:
        _print(result, harm, entries, [path for path in (json, video, html) if path is not None])
    return 1 if harm else 0


def _scene(name: str | None, map: Path | None, base: Pose | None, *, with_camera: bool) -> Scene:
    from splatbot.sim.maps.placed import placed_scene
    from splatbot.sim.scene import load_scene, make_scene

    values: dict[str, Any] = {}
    if map is not None:
        values = placed_scene(map, T_world_base=None if base is None else checked_pose(base, "--base"))
    else:
        assert name is not None
        found = load_scene(name)
        if found.camera is not None or not with_camera:
            return found
        values = found.model_dump() | {"folder": found.folder}
    if with_camera:
        values["camera"] = CAMERA
    return make_scene(values)


def _check_offsets(trajectory: Path, arm: RobotModel) -> None:
    """Check that a plan or a motion of a pick is of the present calibration of an arm.

    The file of another program has no plan.json or pick.json next to it. Its positions are those that the arm reports.

    Raises:
        FormatError: the file of the plan is damaged, or of another calibration.
    """
    import json as text

    from splatbot.workspace import same_offsets

    file = trajectory.with_name("plan.json" if trajectory.stem == "trajectory" else "pick.json")
    if not file.is_file():
        return
    hint = "plan again, in this map"
    try:
        planned = text.loads(file.read_text())["joint_offsets"]
        same = same_offsets(planned, arm.joint_offsets)
    except (ValueError, KeyError, TypeError) as error:
        problem = f"does not name the joint offsets of its arm ({error!r})."
        raise FormatError(problem, file=file, field="joint_offsets", hint=hint) from error
    if not same:
        problem = "differ from those of the scene: the arm was calibrated since."
        raise FormatError(problem, file=file, field="joint_offsets", hint=hint)


def _harm(scene: Scene, result: TwinResult) -> bool:
    """Return whether the arm had an unintended contact, or the simulation was unstable."""
    may_touch = scene.task.kind in ("push", "grasp", "hang", "wipe", "squeeze")
    return bool((result.contacts and not may_touch) or any("unstable" in text for text in result.warnings))


def _watchers(*watchers: Callable[[Any, float], None] | None) -> Callable[[Any, float], None] | None:
    there = [watch for watch in watchers if watch is not None]
    if not there:
        return None

    def watch_all(data: Any, time: float) -> None:
        for watch in there:
            watch(data, time)

    return watch_all


def _write_page(path: Path, recording: TwinRecording, result: TwinResult) -> None:
    from splatbot.atomic import atomic_write
    from splatbot.sim.page import twin_html

    with atomic_write(path) as file:
        file.write(twin_html(recording, result).encode())


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[float], None] | None]:
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with without_line(), Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("simulating", total=1.0)
        yield lambda share: bars.update(task, completed=share)


def _write(path: Path, result: TwinResult, entries: list[LedgerEntry], sensor: list[dict[str, Any]]) -> None:
    import json as text
    from dataclasses import asdict

    from splatbot.atomic import atomic_write

    values = result.to_dict()
    del values["decisions"]
    values |= {"effects": [asdict(entry) for entry in entries], "sensor_effects": sensor}
    with atomic_write(path) as file:
        file.write(text.dumps(values, indent=1).encode() + b"\n")


def _print(result: TwinResult, harm: bool, entries: list[LedgerEntry], written: list[Path]) -> None:
    from rich.console import Console
    from rich.table import Table

    from splatbot.cli.tables import print_columns, print_text

    console = Console(width=None if sys.stdout.isatty() else 140)
    style = "bold red" if harm else "bold green"
    console.print(f"verdict: {_verdict(result, harm)}", style=style, markup=False, highlight=False)
    console.print(
        f"{result.scene}: {result.duration:.2f} s in {result.steps} steps of {1e3 * result.timestep:g} ms, "
        f"{_pace(result.real_time)}"
    )
    for note in result.notes:
        console.print(f"  {note}")
    if result.tracking is not None:
        t = result.tracking
        console.print(
            f"tracking: {1e3 * t.rms:.2f} mrad RMS, {1e3 * t.largest:.2f} at most; tool {1e3 * t.tcp:.2f} mm at most"
        )
    near = result.clearance
    where = f" ({near.part} and {near.other} at {near.time:.2f} s)" if near.part else " or more"
    console.print(f"minimum clearance of the arm: {1e3 * near.value:.1f} mm{where}")
    for contact in result.contacts:
        console.print(
            f"contact: {contact.part} and {contact.other}, {contact.first:.3f} to {contact.last:.3f} s, "
            f"{1e3 * contact.depth:.2f} mm deep, {contact.force:.1f} N"
        )
    for name in result.dropped:
        console.print(f"fell: {name}")
    for text in result.warnings:
        console.print(f"[yellow]warning: {text}[/yellow]")
    for path in written:
        console.print(f"written to {path}")
    table = Table("effect", "why", "ms", "us a step", title="active effects", title_justify="left")
    for entry in entries:
        cost = ("", "") if entry.ms is None else (f"{entry.ms:+.1f}", f"{entry.us_per_step:+.2f}")
        if entry.on:
            table.add_row(entry.name, entry.why, *cost)
    if table.row_count:
        print_columns(table, console)
    overruled = [f"{entry.name} ({entry.why})" for entry in entries if not entry.on and entry.by != "scene"]
    if overruled:
        print_text(f"inactive: {', '.join(overruled)}")
    unneeded = [entry.name for entry in entries if not entry.on and entry.by == "scene" and entry.observable]
    if unneeded:
        print_text(f"not needed here: {', '.join(unneeded)}; --json FILE has the reasons")


def _verdict(result: TwinResult, harm: bool) -> str:
    """Return one line on the run: contacts, stability and fallen objects, and whether they forbid to execute it."""
    touched = dict.fromkeys(f"{contact.part} and {contact.other}" for contact in result.contacts)
    if harm:
        unstable = [text for text in result.warnings if "unstable" in text]
        found = [*unstable, *(f"unintended contact of {pair}" for pair in touched)]
        text = f"do not execute: {'; '.join(found)}"
    elif touched:
        text = f"contacts, which the task allows: {', '.join(touched)}"
    else:
        text = "no contact of the arm"
    return f"{text}; fell: {', '.join(result.dropped)}" if result.dropped else text


def _pace(real_time: float) -> str:
    """Return words for simulated seconds in each second."""
    if real_time >= 1.0:
        return f"{real_time:.1f} times faster than real time"
    return f"{1 / max(real_time, 1e-9):.1f} times slower than real time"


def _print_lists() -> None:
    from splatbot.cli.tables import print_table
    from splatbot.sim.effects.physics import PHYSICS, physics_effect
    from splatbot.sim.effects.registry import EFFECTS, effect_class
    from splatbot.sim.scene import load_scene, scene_names

    print_table([(name, load_scene(name).about) for name in scene_names()], title="scenes")
    print_table([(name, physics_effect(name).cost) for name in PHYSICS], title="physics, and its cost")
    print_table([(name, effect_class(name).cost) for name in EFFECTS], title="the camera's sensor, and its cost")
