"""Robots by name: shipped ones, and those added from their descriptions."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.protocols import HandShape, LinkSpheres
from splatbot.robots.arms import ARMS, arm_file
from splatbot.robots.hands import attach, find_hand, panda_2f85, panda_2f140
from splatbot.robots.joints import Joint
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.panda import panda
from splatbot.robots.robot import GripperGeometry, Inertial, RobotModel
from splatbot.robots.shapes import Capsule
from splatbot.robots.visual import load_visual, save_visual

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,79}")
_FORMAT = "splatbot robot 1"


@cache
def _shipped() -> dict[str, Callable[[], RobotModel]]:
    """Return the robots that splatbot ships, by name: each arm, and each with the hands that it can carry."""
    found: dict[str, Callable[[], RobotModel]] = {
        "panda": panda, "panda-2f85": panda_2f85, "panda-2f140": panda_2f140,
    }  # fmt: skip
    for name, arm in ARMS.items():
        found[name] = partial(_shipped_arm, name)
        found |= {f"{name}-{hand}": partial(_with_hand, name, hand) for hand in arm.hands}
    return found


@cache
def _shipped_arm(name: str) -> RobotModel:
    return read_robot(arm_file(name))


@cache
def _with_hand(name: str, hand: str) -> RobotModel:
    return attach(_shipped_arm(name), find_hand(hand))


def robots_folder() -> Path:
    """Return the folder of added robots: SPLATBOT_ROBOTS, or splatbot/robots in the user's data folder."""
    chosen = os.environ.get("SPLATBOT_ROBOTS")
    data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return Path(chosen) if chosen else data / "splatbot" / "robots"


def robot_file(name: str) -> Path:
    """Return the file that an added robot is kept in, which is in :func:`robots_folder`.

    Raises:
        InputError: the name is that of a shipped robot or cannot be that of a file.
    """
    if name in _shipped() or not _NAME.fullmatch(name):
        hint = "give another --name: letters, digits, - _ . after a letter or digit, at most 80"
        raise InputError(f"{name[:80]!r} is no name of an added robot.", field="name", hint=hint)
    return robots_folder() / f"{name}.json"


def robot_names() -> list[str]:
    """Return the names of all robots."""
    folder = robots_folder()
    added = sorted(path.stem for path in folder.glob("*.json")) if folder.is_dir() else []
    return [*_shipped(), *(name for name in added if name not in _shipped())]


def load_robot(name: str | Path) -> RobotModel:
    """Load a robot by name, or from a file of :func:`save_robot`.

    Raises:
        InputError: no robot has that name, or a shipped and an added one have it.
        FormatError: the file is damaged.
    """
    path = Path(name) if str(name).endswith(".json") else robots_folder() / f"{name}.json"
    if (shipped := _shipped().get(str(name))) is not None:
        if path.is_file():
            hint = "rename the file, and use its new name, or delete it"
            raise InputError(f"{str(name)!r} is a shipped robot too.", field="robot", file=path, hint=hint)
        return shipped()
    if not path.is_file():
        raise InputError(
            f"there is no robot {str(name)!r}.",
            field="robot",
            hint=f"robots: {', '.join(robot_names())}; add one with `splatbot robot add FILE.urdf`",
        )
    return read_robot(path)


def save_robot(robot: RobotModel, path: Path) -> None:
    """Write joints, spheres, gripper and other inputs of checks and planning; the shapes of links are not saved.

    Visual meshes go to a file of the same name that ends in ``.npz``.
    """
    spheres = robot.link_spheres
    document = {
        "format": _FORMAT,
        "name": robot.name,
        "joints": [
            {
                "name": j.name,
                "T_before_joint": j.T_before_joint.tolist(),
                "limits": [j.lower, j.upper, j.velocity, j.acceleration, j.jerk, j.effort],
                "prismatic": j.prismatic,
            }
            for j in robot.joints
        ],
        "T_link_tcp": robot.T_link_tcp.tolist(),
        "home": robot.home.tolist(),
        "slack": robot.slack,
        "inertials": [[i.mass, list(i.center), i.inertia.tolist()] for i in robot.inertials],
        "pairs": robot.self_collision_pairs.tolist(),
        "spheres": np.c_[spheres.link, spheres.centers, spheres.radii].tolist(),
        "gripper": _gripper_document(robot),
        "link_frames": _link_frames_document(robot),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(json.dumps(document, indent=1).encode())
    meshes = path.with_suffix(".npz")
    if robot.visual:
        save_visual(robot.visual, meshes)
    else:
        meshes.unlink(missing_ok=True)  # of a robot that was replaced


def read_robot(path: Path) -> RobotModel:
    """Read a robot from a file of :func:`save_robot`.

    Raises:
        FormatError: the file is missing or damaged.
    """
    meshes = path.with_suffix(".npz")
    try:
        d: dict[str, Any] = json.loads(path.read_text())
        if d["format"] != _FORMAT:
            raise ValueError(f"format {d['format']!r}")
        spheres = np.array(d["spheres"], dtype=np.float64).reshape(-1, 5)
        return RobotModel(
            name=str(d["name"]),
            joints=tuple(_joint(j) for j in d["joints"]),
            shapes=(),
            T_link_tcp=np.array(d["T_link_tcp"], dtype=np.float64),
            home=np.array(d["home"], dtype=np.float64),
            inertials=tuple(Inertial(float(m), tuple(c), np.array(i)) for m, c, i in d["inertials"]),
            slack=float(d["slack"]),
            covering=LinkSpheres(spheres[:, 0].astype(np.int32), np.ascontiguousarray(spheres[:, 1:4]), spheres[:, 4]),
            pairs=np.array(d["pairs"], dtype=np.int32).reshape(-1, 2),
            gripper=None if d.get("gripper") is None else _gripper(d["gripper"]),
            visual=load_visual(meshes, len(d["joints"]) + 1) if meshes.is_file() else (),
            link_frames=None if d.get("link_frames") is None else _link_frames(d["link_frames"]),
        )
    except FormatError:
        raise
    except (OSError, ValueError, KeyError, TypeError, InputError) as error:
        raise FormatError(f"is no robot ({error}).", file=path, hint="add it again: splatbot robot add") from error


def _joint(j: dict[str, Any]) -> Joint:
    lower, upper, velocity, acceleration, jerk, effort = (float(x) for x in j["limits"])
    T = np.array(j["T_before_joint"], dtype=np.float64).reshape(4, 4)
    return Joint(str(j["name"]), T, lower, upper, velocity, acceleration, jerk, effort, bool(j["prismatic"]))


def _link_frames_document(robot: RobotModel) -> list[dict[str, Any]] | None:
    frames = robot.link_frames
    if frames is None:
        return None
    return [
        {"name": name, "T_frame_link": T.tolist()} for name, T in zip(frames.names, frames.T_frame_link, strict=True)
    ]


def _link_frames(d: list[dict[str, Any]]) -> LinkFrames:
    return LinkFrames(
        tuple(str(frame["name"]) for frame in d), np.array([frame["T_frame_link"] for frame in d], dtype=np.float64)
    )


def _gripper_document(robot: RobotModel) -> dict[str, Any] | None:
    gripper = robot.gripper
    if gripper is None:
        return None
    return {
        "T_link_finger": gripper.T_link_finger.tolist(),
        "stroke": gripper.stroke,
        "speed": gripper.speed,
        "force": gripper.force,
        "capsules": [[s.start, s.end, s.radius] for s in gripper.shapes if isinstance(s, Capsule)],
        "spheres": np.c_[robot.finger_spheres.centers, robot.finger_spheres.radii].tolist(),
        "hand": None if robot.hand is None else asdict(robot.hand),
    }


def _gripper(d: dict[str, Any]) -> GripperGeometry:
    spheres = np.array(d["spheres"], dtype=np.float64).reshape(-1, 4)
    hand = d["hand"]
    return GripperGeometry(
        np.array(d["T_link_finger"], dtype=np.float64).reshape(2, 4, 4),
        float(d["stroke"]),
        tuple(Capsule(0, tuple(a), tuple(b), float(radius)) for a, b, radius in d["capsules"]),
        speed=float(d["speed"]),
        force=float(d["force"]),
        covering=LinkSpheres(np.zeros(len(spheres), np.int32), np.ascontiguousarray(spheres[:, :3]), spheres[:, 3]),
        hand=None if hand is None else HandShape(**(hand | {"palm_size": tuple(hand["palm_size"])})),
    )
