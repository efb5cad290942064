"""`splatbot robot`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def robot(
    action: Annotated[Literal["add", "list", "info", "mjcf"], tyro.conf.Positional, tyro.conf.arg(metavar="ACTION")],
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|PATH")] = "panda",
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    tip: Annotated[str | None, tyro.conf.arg(metavar="LINK")] = None,
    slack: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None,
) -> int:
    """Add a robot arm, or describe a stored one.

    The action `add` reads a URDF, covers its collision geometry with spheres, checks the cover, and stores it under its
    name. The action `list` prints the names of the robots. The action `info` prints joints, limits and spheres. The
    action `mjcf` writes a MuJoCo model.

    Examples:
        splatbot robot add ur5.urdf --tip tool0
        splatbot robot info panda
        splatbot robot mjcf panda --out panda.xml

    Args:
        action: the action.
        name: a robot's name; for add, the URDF file.
        out: add: a file to keep the robot in; mjcf: the file to write (else it is printed).
        tip: add: the link at the arm's end; by default that with most moving joints before it.
        slack: add: largest distance of the spheres beyond the geometry [m]; 0.02 by default.
    """
    if action == "add":
        return _add(Path(name), out, tip, 0.02 if slack is None else slack)
    if action == "list":
        from splatbot.robots.store import robot_names

        print("\n".join(robot_names()))
        return 0
    from splatbot.robots.store import load_robot

    model = load_robot(name)
    if action == "info":
        _info(name)
        return 0
    from splatbot.robots.mjcf import to_mjcf

    text = to_mjcf(model)
    if out is None:
        print(text, end="")
    else:
        out.write_text(text)
        print(f"written to {out}")
    return 0


def _add(path: Path, out: Path | None, tip: str | None, slack: float) -> int:
    from splatbot.robots.cover import uncovered
    from splatbot.robots.store import robot_file, save_robot
    from splatbot.robots.urdf import read_urdf

    reading = read_urdf(path, tip=tip, slack=slack)
    for note in reading.notes:
        print(f"note: {note}")
    file = out if out is not None else robot_file(reading.robot.name)
    spheres = reading.robot.spheres()
    beyond = uncovered(reading.robot.shapes, spheres, slack / 3)
    save_robot(reading.robot, file)
    inside = beyond <= 1e-9
    state = "all of it is inside" if inside else f"{1e3 * beyond:.2f} mm of it sticks out"
    print(f"{reading.robot.name}: {len(reading.robot)} joints, {len(spheres)} spheres within {1e3 * slack:g} mm of the")
    print(f"geometry; {state}. Kept in {file}")
    return 0 if inside else 1


def _info(name: str) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.robots.store import load_robot

    model = load_robot(name)
    spheres = model.spheres()
    rows = [
        (
            j.name,
            f"{j.lower:+.4f} .. {j.upper:+.4f}, at most {j.velocity:g}/s, {j.acceleration:g}/s², effort {j.effort:g}",
        )
        for j in model.joints
    ]
    print_table(rows, title=f"{model.name}: {len(model)} joints")
    print_table(
        [
            ("spheres", f"{len(spheres)}, radius {spheres.radii.min():.3f} .. {spheres.radii.max():.3f} m"),
            ("slack", f"{1e3 * model.slack:g} mm"),
            ("pairs of links that may not touch", str(len(model.self_collision_pairs))),
            ("gripper", f"opens {2 * model.gripper.stroke:g} m" if model.gripper else "none"),
        ]
    )
