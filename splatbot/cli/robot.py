"""`splatbot robot`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from splatbot.robots.bodies.check import Part
    from splatbot.robots.joints import Joint
    from splatbot.robots.robot import RobotModel


def robot(
    action: Annotated[
        Literal["add", "list", "info", "fit", "mjcf"], tyro.conf.Positional, tyro.conf.arg(metavar="ACTION")
    ],
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|PATH")] = "panda",
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    tip: Annotated[str | None, tyro.conf.arg(metavar="LINK")] = None,
    slack: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None,
    rename: Annotated[str | None, tyro.conf.arg(metavar="NAME", name="name")] = None,
    gripper: Annotated[str | None, tyro.conf.arg(metavar="HAND")] = None,
    overwrite: bool = False,
    check_meshes: bool = False,
) -> int:
    """Add a robot arm, or describe a stored one.

    The action `add` reads a URDF, xacro or MJCF file. It covers collision and visual geometry with spheres, proves that
    they contain it, and stores the arm under its name. The action `list` prints the names of the robots. The action
    `info` prints joints, limits and spheres. The action `fit` fits the certified body of a shipped arm to the meshes of
    its maker. The action `mjcf` writes a MuJoCo model.

    Examples:
        splatbot robot add ur5.urdf --tip tool0
        splatbot robot add ur5.urdf --tip tool0 --gripper 2f85
        splatbot robot add ur5e --gripper my_gripper.urdf --name lab-ur5e
        splatbot robot add menagerie/ufactory_xarm7/xarm7.xml --name lab-xarm
        splatbot robot info panda
        splatbot robot info panda --check-meshes --out panda-body.png
        splatbot robot info ur5e-2f85 --check-meshes
        splatbot robot fit panda --slack 0.011 --out panda.json
        splatbot robot mjcf panda --out panda.xml

    Args:
        action: the action.
        name: a robot's name; for add, the file, or a shipped arm that gets a hand.
        out: the file to write; mjcf prints without one. info --check-meshes draws runs/robot/NAME-body.png, and fit
            writes NAME.json.
        tip: add: the link at the arm's end (MJCF: a body or site); by default the last one before fingers.
        slack: largest distance of the spheres beyond the geometry [m]; for fit panda 0.011 by default. By default add
            takes 2 % of the reach. It takes more if that needs too many spheres.
        rename: add: the name to store the arm under; by default that in the file.
        gripper: add: attach a hand to the tool frame, whose z axis points outwards. It is 2f85, 2f140, panda_hand, or
            the URDF of two prismatic fingers.
        overwrite: add: replace a robot of that name.
        check_meshes: info: prove that the spheres contain the meshes of the maker, which a package must provide.
    """
    if action == "add":
        return _add(Path(name), out, rename, tip, slack, gripper, overwrite)
    if action == "list":
        from splatbot.robots.store import robot_names

        print("\n".join(robot_names()))
        return 0
    if action == "fit":
        return _fit(name, out, slack)
    from splatbot.robots.store import load_robot

    model = load_robot(name)
    if action == "info":
        _info(name)
        return _check_meshes(name, out) if check_meshes else 0
    from splatbot.robots.mjcf import to_mjcf

    text = to_mjcf(model)
    if out is None:
        print(text, end="")
    else:
        out.write_text(text)
        print(f"written to {out}")
    return 0


def _check_known(name: str) -> None:
    """Refuse a robot or hand whose maker's meshes are not known.

    Raises:
        InputError: they are not.
    """
    from splatbot.errors import InputError
    from splatbot.robots.arms import ARMS
    from splatbot.robots.sources import SOURCES

    if name not in SOURCES and name not in ARMS:
        known = ", ".join([*SOURCES, *ARMS])
        raise InputError(f"has no known meshes: {name!r}.", field="robot", hint=f"known: {known}")


def _fit(name: str, out: Path | None, slack: float | None) -> int:
    from splatbot.errors import InputError
    from splatbot.robots.arms import ARMS
    from splatbot.robots.arms.fit import fit_arm
    from splatbot.robots.bodies import fit_body, save_body
    from splatbot.robots.sources import SOURCES
    from splatbot.robots.store import save_robot

    _check_known(name)
    file = out if out is not None else Path(f"{name}.json")
    if name in ARMS:
        if slack is not None:
            raise InputError("is fixed for a shipped arm.", field="--slack", hint="leave it out")
        save_robot(fit_arm(name, print), file)
    else:
        save_body(fit_body(SOURCES[name], 0.011 if slack is None else slack, print), file)
    print(f"written to {file}")
    return 0


def _check_meshes(name: str, out: Path | None) -> int:
    """Print containment and slack of each part; return 1 if a part is not contained."""
    from splatbot.cli.tables import print_table, print_text
    from splatbot.robots.bodies.check import check_parts, draw_parts
    from splatbot.robots.hands import HAND_NAMES

    arm, _, suffix = name.partition("-")
    arm, hand = (arm, suffix) if suffix in HAND_NAMES else (name, "")
    parts, title = _arm_parts(arm, own_hand=not hand)
    if hand:
        of_hand, hand_title = _hand_parts(hand)
        parts, title = parts | of_hand, f"{title}; {hand_title}"
    checks = check_parts(parts)
    print_text(title)
    print_table(
        [
            (
                p.part,
                f"{p.spheres} spheres, largest uncovered distance {1e3 * p.uncovered:.2f} mm, slack "
                f"{1e3 * p.slack.median:.1f} mm (median), {1e3 * p.slack.most99:.1f} mm (99 %)",
            )
            for p in checks
        ]
    )
    picture = out if out is not None else Path("runs") / "robot" / f"{name}-body.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw_parts(parts, picture)
    print(f"picture: {picture}")
    return 0 if max(p.uncovered for p in checks) <= 0 else 1


def _arm_parts(name: str, *, own_hand: bool) -> tuple[dict[str, Part], str]:
    """Return the parts of an arm, with or without the hand of its maker, and the source of its meshes."""
    from splatbot.robots.arms import ARMS
    from splatbot.robots.arms.fit import described
    from splatbot.robots.bodies import load_body
    from splatbot.robots.bodies.check import parts_of_arm, parts_of_body
    from splatbot.robots.sources import SOURCES
    from splatbot.robots.store import load_robot

    _check_known(name)
    if name in ARMS:
        source, robot = ARMS[name].source, load_robot(name)
        return parts_of_arm(described(name).shapes, robot.spheres(), robot), source.title()
    source, body = SOURCES[name], load_body(name)
    parts = parts_of_body(body, source)
    if body.source["sha256"] != source.digest():
        print("note: the body was fitted to other meshes than those that are installed")
    return {part: own for part, own in parts.items() if own_hand or part not in ("hand", "finger")}, source.title()


def _hand_parts(name: str) -> tuple[dict[str, Part], str]:
    """Return the parts of a hand and the source of its meshes.

    Raises:
        InputError: no package has them.
    """
    from splatbot.errors import InputError

    if name == "2f140":
        hint = "check the arm alone; its shapes are drawn from the data sheet"
        raise InputError("has no published meshes, so that nothing is proven.", field=name, hint=hint)
    parts, title = _arm_parts("panda" if name == "panda_hand" else name, own_hand=True)
    return {part: parts[part] for part in ("hand", "finger")}, title


def _add(
    path: Path,
    out: Path | None,
    rename: str | None,
    tip: str | None,
    slack: float | None,
    gripper: str | None,
    overwrite: bool,
) -> int:
    from dataclasses import replace

    from splatbot.cli.tables import print_text
    from splatbot.errors import InputError
    from splatbot.robots.arms import ARMS
    from splatbot.robots.hands import Hand, attach, find_hand

    of_file = gripper is not None and Path(gripper).suffix in (".urdf", ".xacro")
    hand: Hand | None = None if gripper is None or of_file else find_hand(gripper)

    from splatbot.robots.containment import uncovered
    from splatbot.robots.description import read_description, visual_of
    from splatbot.robots.hand_reader import read_hand
    from splatbot.robots.reading import simplified
    from splatbot.robots.store import load_robot, robot_file, save_robot
    from splatbot.robots.visual import visual_meshes

    notes: tuple[str, ...] = ()
    if gripper is not None and of_file:
        read = read_hand(gripper)
        hand, notes = read.hand, read.notes
    stored = str(path) in ARMS and not path.exists()
    if stored and hand is None:
        raise InputError("is shipped.", field=str(path), hint="attach a hand with --gripper, or give a file")
    for option, value in (("--tip", tip), ("--slack", slack)):
        if stored and value is not None:
            raise InputError("is fixed for a shipped arm.", field=option, hint="leave it out")
    if stored:
        arm = load_robot(str(path))
    else:
        reading = read_description(path, tip=tip, slack=slack)
        arm, notes = replace(reading.robot, visual=visual_of(path, tip=tip)), (*reading.notes, *notes)
    suffix = "" if hand is None else f"-{hand.name}"
    arm = replace(arm, name=rename or f"{arm.name}{suffix}")
    for note in notes:
        print_text(f"note: {note}")
    file = out if out is not None else robot_file(arm.name)
    if file.exists() and not overwrite:
        raise InputError("exists.", file=file, hint="give another --name, or replace it with --overwrite")
    if not stored:
        print_text(
            f"{arm.name}: {len(arm)} joints; fitting spheres within {1e3 * arm.slack:.0f} mm of its geometry ..."
        )
        arm = simplified(arm, slack is None)
    if hand is not None:
        bare, arm = arm, replace(attach(arm, hand), name=arm.name)
        arm = replace(arm, visual=visual_meshes([*bare.visual, *arm.shapes[len(bare.shapes) :]]))
    beyond = uncovered(arm.shapes, arm.spheres())
    save_robot(arm, file)
    inside = beyond <= 1e-9
    state = "all of it is inside" if inside else f"{1e3 * beyond:.2f} mm of it sticks out"
    print(f"{len(arm.spheres())} spheres within {1e3 * arm.slack:.0f} mm of the geometry; {state}")
    print(f"stored in {file}")
    return 0 if inside else 1


def _info(name: str) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.robots.store import load_robot

    model = load_robot(name)
    spheres = model.spheres()
    rows = [(joint.name, _joint_text(joint)) for joint in model.joints]
    print_table(rows, title=f"{model.name}: {len(model)} joints")
    print_table(
        [
            ("spheres", f"{len(spheres)}, radius {spheres.radii.min():.3f} .. {spheres.radii.max():.3f} m"),
            ("slack", f"the spheres reach at most {1e3 * model.slack:.3g} mm beyond the geometry"),
            ("pairs of links that may not touch", str(len(model.self_collision_pairs))),
            ("home", " ".join(f"{value:.4g}" for value in model.home) + f" {_unit_of(model)}"),
            ("gripper", _gripper_text(model)),
            ("tool (TCP)", _tool_text(model)),
            ("links in TF", _links_text(model)),
            *([("mass", f"last link with its hand {model.inertials[-1].mass:.3g} kg")] if model.inertials else []),
        ]
    )


def _joint_text(joint: Joint) -> str:
    unit, effort = ("m", "N") if joint.prismatic else ("rad", "Nm")
    limits = f"at most {joint.velocity:g} {unit}/s, {joint.acceleration:g} {unit}/s², {joint.effort:g} {effort}"
    return f"{joint.lower:+.4f} .. {joint.upper:+.4f} {unit}, {limits}"


def _unit_of(model: RobotModel) -> str:
    """Return the unit of joint values."""
    kinds = {joint.prismatic for joint in model.joints}
    return "rad or m" if len(kinds) == 2 else "m" if True in kinds else "rad"


def _gripper_text(model: RobotModel) -> str:
    gripper = model.gripper
    if gripper is None:
        return "none"
    return f"opens {2 * gripper.stroke:g} m, force {gripper.force:g} N, {gripper.speed:g} m/s each finger"


def _links_text(model: RobotModel) -> str:
    frames = model.link_frames
    return "no names: add its URDF or MJCF again" if frames is None else ", ".join(frames.names)


def _tool_text(model: RobotModel) -> str:
    """Describe the tool frame, which users compare with that of their controller."""
    import numpy as np

    T = model.T_link_tcp
    x, y, z = (f"{value:+.4f}" for value in T[:3, 3])
    turn = "" if np.allclose(T[:3, :3], np.eye(3)) else ", turned"
    return f"at {x} {y} {z} m in the frame of {model.joints[-1].name}{turn}; z is the approach, fingers close along y"
