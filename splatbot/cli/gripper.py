"""`splatbot gripper`."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from splatbot.robots.grippers import RobotiqGripper


def gripper(
    action: Annotated[
        Literal["status", "open", "close", "move", "activate", "release"],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="ACTION"),
    ],
    /,
    port: Annotated[str | None, tyro.conf.arg(metavar="DEVICE")] = None,
    model: Literal["2f-85", "2f-140"] = "2f-85",
    opening: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None,
    force: Annotated[float | None, tyro.conf.arg(metavar="NEWTONS")] = None,
    speed: Annotated[float | None, tyro.conf.arg(metavar="M_S")] = None,
    fake: bool = False,
    fake_width: Annotated[float, tyro.conf.arg(metavar="METRES")] = 0.0,
) -> int:
    """Query or move a Robotiq 2F gripper on a serial port, or a simulated one.

    The action `status` prints its state. The actions `open`, `close` and `move` move the fingers, wait, and print the
    state. The action `activate` resets it and activates it again; its fingers close and open. The action `release`
    opens it slowly at any time. A move activates the gripper first if necessary.

    Examples:
        splatbot gripper status --port /dev/ttyUSB0
        splatbot gripper close --port /dev/ttyUSB0 --force 40 --speed 0.05
        splatbot gripper close --fake --fake-width 0.03

    Args:
        action: the action.
        port: the serial device.
        model: model of the gripper.
        opening: distance between the fingers for move [m].
        force: largest force [N].
        speed: largest speed [m/s].
        fake: simulate a gripper on a pseudo-terminal instead of --port.
        fake_width: width of a simulated object between its fingers [m].
    """
    from splatbot.errors import InputError
    from splatbot.robots.grippers import FakeRobotiq, RobotiqGripper

    if (port is None) != fake:
        raise InputError("must be given, one of the two.", field="--port, --fake", hint="name a serial device")
    if (opening is None) == (action == "move"):
        raise InputError("goes with move, and only with it.", field="--opening", hint="give metres between the fingers")
    with ExitStack() as stack:
        if port is None:
            port = stack.enter_context(FakeRobotiq(model, width=fake_width)).port
        hand = stack.enter_context(RobotiqGripper(port, model))
        if action == "release":
            hand.release()
            print("the gripper opens; activate it before it moves again")
            return 0
        if action == "activate":
            hand.activate(again=True)
        elif action != "status":
            goal = {"open": hand.stroke, "close": 0.0}.get(action, opening)
            assert goal is not None
            _move(hand, goal, force, speed)
        _print(hand, port)
    return 0


def _move(hand: RobotiqGripper, opening: float, force: float | None, speed: float | None) -> None:
    hand.activate()
    try:
        hand.move(opening, force=force, speed=speed)
        hand.wait(20.0)
    except KeyboardInterrupt:
        hand.stop()
        raise


def _print(hand: RobotiqGripper, port: str) -> None:
    from splatbot.cli.tables import print_table

    status = hand.status()
    rows = [
        ("activation", status.activation.name.lower()),
        ("opening", f"{1e3 * hand.model.opening(status.position):.1f} of {1e3 * hand.stroke:g} mm"),
        ("fingers", _FINGERS[status.fingers.name] if status.going else "do not move"),
        ("current", f"{status.current} mA"),
        ("exchanges repeated", str(hand.repeated)),
    ]
    print_table(rows, title=f"gripper on {port}")


_FINGERS = {
    "MOVING": "move",
    "STOPPED_OPENING": "hold something, from within",
    "STOPPED_CLOSING": "hold something",
    "THERE": "reached the commanded opening, and hold nothing",
}
