"""The arm of a scene, whose true joint positions differ from those that it reports."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from splatbot.errors import InputError
from splatbot.robots.hands import HAND_NAMES
from splatbot.robots.joints import Joint
from splatbot.robots.robot import RobotModel, joint_transform
from splatbot.workspace import NAME, Workspace


def robot_in_scene(robot: RobotModel, scene: Workspace | None) -> RobotModel:
    """Return the robot with the joint offsets δ of a scene: its positions are those that the arm reports.

    Plans, certificates, grasps and twins of this model are in reported positions q, which are also those of commands.
    Its links are at q + δ. Both q and q + δ keep the limits.

    Args:
        robot: model by its manufacturer.
        scene: description of the scene. Without joint offsets, the robot is returned as it is.

    Raises:
        InputError: the offsets are those of another arm, or their arm is not named. There is not one offset for each
            joint, or an offset leaves a joint no position.
    """
    if scene is None or scene.joint_offsets is None or not scene.joint_offsets.any():
        return robot
    arm = arm_name(robot.name)
    if not scene.offsets_of:
        hint = f"add offsets_of: {arm} if they were calibrated for it, or calibrate again: splatbot calibrate hand-eye"
        raise InputError("does not name the arm of the joint_offsets.", file=NAME, field="offsets_of", hint=hint)
    if scene.offsets_of != arm:
        hint = f"name a robot with the arm {scene.offsets_of}, or calibrate {arm}: splatbot calibrate hand-eye"
        raise InputError(f"are those of {scene.offsets_of}, not {arm}.", file=NAME, field="joint_offsets", hint=hint)
    if len(scene.joint_offsets) != len(robot):
        hint = f"{robot.name} has {len(robot)} joints"
        raise InputError(f"has {len(scene.joint_offsets)} values.", file=NAME, field="joint_offsets", hint=hint)
    return _with_offsets(robot, tuple(scene.joint_offsets.tolist()))


def arm_name(robot: str) -> str:
    """Return the name of a robot's arm: that of the robot without the hand, as ``panda`` of ``panda-2f85``."""
    arm, _, hand = robot.rpartition("-")
    return arm if hand in HAND_NAMES else robot


@lru_cache(maxsize=8)
def _with_offsets(robot: RobotModel, offsets: tuple[float, ...]) -> RobotModel:
    joints = tuple(_with_offset(joint, offset) for joint, offset in zip(robot.joints, offsets, strict=True))
    hand = None
    if robot.gripper is not None:
        hand = replace(robot.gripper, covering=robot.finger_spheres, hand=robot.hand)
    return replace(
        robot,
        joints=joints,
        home=np.clip(robot.home, [joint.lower for joint in joints], [joint.upper for joint in joints]),
        gripper=hand,
        covering=robot.link_spheres,
        pairs=robot.self_collision_pairs,
        joint_offsets=offsets,
    )


def _with_offset(joint: Joint, offset: float) -> Joint:
    """Return a joint whose position q is the position q + offset [rad or m] of the given one."""
    low, high = joint.lower + max(0.0, -offset), joint.upper - max(0.0, offset)
    if low > high:
        hint = "calibrate the arm again: splatbot calibrate hand-eye"
        raise InputError(f"of {joint.name} is {offset:g}, more than its range.", field="joint_offsets", hint=hint)
    T = joint.T_before_joint @ joint_transform(np.array(offset), joint.prismatic)
    return replace(joint, T_before_joint=T, lower=low, upper=high)
