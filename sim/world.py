"""A scene as a MuJoCo model: bodies first, then the active effects, one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import ConfigError, InputError
from splatbot.geometry import rotation_to_quat
from splatbot.robots.mjcf import to_mjcf
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot
from splatbot.sim.clutter import MapParts, add_ellipsoids, load_parts
from splatbot.sim.effects.decisions import EffectDecision
from splatbot.sim.effects.physics import PHYSICS, Hook, effects_for, physics_effect
from splatbot.sim.scene import CameraSection, Scene, SceneObject
from splatbot.sim.solids import quat_of

OBJECT = "object/"
CAMERA = "camera"
MAP = "map"
MAP_GROUP = 2  # of the map's collision geometry, which rendering can hide
BODY_GROUP = 5  # of the robot's collision geometry in a world for views
_MOVABLE_MASS = 0.2  # [kg]


@dataclass
class Draft:
    """A model under construction.

    Args:
        scene: description.
        spec: MuJoCo's specification, without the physics of effects.
        robot: the arm, or None.
        robot_bodies: bodies of the arm.
        bodies: body of each object, by name.
        map_geoms: of the map's clutter, in the world body.
    """

    scene: Scene
    spec: Any
    robot: RobotModel | None
    robot_bodies: list[Any] = field(default_factory=list)
    bodies: dict[str, Any] = field(default_factory=dict)
    map_geoms: list[Any] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class World:
    """A compiled scene.

    Args:
        scene: description.
        robot: the arm, or None.
        spec: the compiled specification.
        model: MuJoCo's model.
        decisions: on every effect, with the reason.
        hooks: callbacks of the effects.
        owner: (G,) name of the link, finger, object or map that each geom belongs to.
        of_robot: (G,) whether the geom belongs to the robot.
        mounted: pairs (link, object) that overlap at home, whose contacts are excluded.
        parts: collision geometry of the map. If None, there is no map.
        notes: on that conversion.
        for_views: whether the model has the robot's meshes for views, see :func:`splatbot.sim.dressing.dressed`.
    """

    scene: Scene
    robot: RobotModel | None
    spec: Any
    model: Any
    decisions: tuple[EffectDecision, ...]
    hooks: tuple[Hook, ...]
    owner: tuple[str, ...]
    of_robot: NDArray[np.bool_]
    mounted: tuple[tuple[str, str], ...] = ()
    parts: MapParts | None = None
    notes: tuple[str, ...] = ()
    for_views: bool = False

    @property
    def on(self) -> tuple[str, ...]:
        """Names of the active effects."""
        return tuple(d.name for d in self.decisions if d.on)

    def name_of(self, geom: int) -> str:
        """Return the name of the link, finger, object or map that a geom of a contact belongs to; -1 is a soft body."""
        return self.owner[geom] if geom >= 0 else "soft body"

    @property
    def harmonics(self) -> int:
        """Spherical harmonics degree at which a camera renders the map."""
        return self.parts.model.sh_degree if self.parts is not None and "view_color" in self.on else 0


def build_world(scene: Scene, *, robot: RobotModel | None = None, timestep: float | None = None) -> World:
    """Compile a scene.

    Args:
        scene: see :mod:`splatbot.sim.scene`.
        robot: replaces the scene's.
        timestep: replaces the scene's [s].

    Raises:
        ConfigError: the scene cannot be built; MuJoCo's reason is in the message.
        InputError: the robot is unknown or has no inertias.
    """
    scene, parts = load_parts(scene)
    draft = _draft(scene, robot)
    if parts is not None and len(parts.ellipsoids.centers):
        draft.map_geoms = add_ellipsoids(draft.spec, parts.ellipsoids)
    if parts is not None:
        replaced = [geom for obj in parts.objects for geom in draft.bodies[obj.name].geoms]
        for geom in (*draft.map_geoms, *replaced):
            geom.group = MAP_GROUP
    decisions = effects_for(scene)
    on = [physics_effect(d.name) for d in decisions if d.on and d.name in PHYSICS]
    for effect in on:
        effect.build(draft)
    draft.spec.option.timestep = scene.timestep if timestep is None else timestep
    draft.spec.option.gravity = list(scene.gravity)
    model = _compiled(draft)
    mounted = _mounts(draft, model)
    if mounted:
        model = _compiled(draft)
    hooks = [effect.hook(model, scene) for effect in on]
    owner, of_robot = owners_of(model)
    return World(
        scene, draft.robot, draft.spec, model, decisions, tuple(h for h in hooks if h is not None), owner, of_robot,
        mounted, parts, _notes(parts, mounted),
    )  # fmt: skip


def _notes(parts: MapParts | None, mounted: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    excluded = tuple(f"{link} overlaps {other} at home: contacts of the two are left out" for link, other in mounted)
    return (parts.notes if parts is not None else ()) + excluded


def _draft(scene: Scene, robot: RobotModel | None) -> Draft:
    arm = None
    spec = mujoco.MjSpec()
    if scene.robot is not None:
        arm = robot if robot is not None else load_robot(scene.robot.model)
        spec = mujoco.MjSpec.from_string(to_mjcf(arm))
        for key in list(spec.keys):
            spec.delete(key)
    draft = Draft(scene, spec, arm)
    if scene.robot is not None and arm is not None:
        _place_robot(draft, arm)
    light = spec.visual.headlight
    light.diffuse, light.ambient = [0.7] * 3, [0.35] * 3
    if scene.camera is not None:
        _add_camera(spec, scene.camera)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for obj in scene.objects:
        draft.bodies[obj.name] = _add_object(draft, obj)
    return draft


def _place_robot(draft: Draft, arm: RobotModel) -> None:
    section = draft.scene.robot
    assert section is not None
    if section.home and len(section.home) != len(arm):
        raise ConfigError(
            f"has {len(section.home)} values for {len(arm)} joints.",
            field="robot.home",
            hint=f"{arm.name} has {len(arm)}",
        )
    draft.robot_bodies = [body for body in draft.spec.bodies if body.name != "world"]
    base = draft.robot_bodies[0]
    base.pos, base.quat = list(section.at), quat_of((0.0, 0.0, section.yaw))
    for actuator in draft.spec.actuators:
        actuator.forcelimited = int(mujoco.mjtLimited.mjLIMITED_FALSE)
        # The controller adds feedforward of gravity and inertia to its targets, which may exceed the joint limits.
        if actuator.name != "opening":
            actuator.ctrllimited = int(mujoco.mjtLimited.mjLIMITED_FALSE)
    for body in draft.robot_bodies:
        for geom in body.geoms:
            geom.condim, geom.rgba = 1, [0.9, 0.9, 0.92, 1.0]


def _add_camera(spec: Any, section: CameraSection) -> None:
    from splatbot.sim.camera import pose_of

    T = pose_of(section)
    camera = spec.worldbody.add_camera(name=CAMERA, pos=T[:3, 3].tolist(), fovy=float(np.degrees(section.fov_y)))
    camera.quat = rotation_to_quat(T[:3, :3] @ np.diag([1.0, -1.0, -1.0]))  # MuJoCo's y is up, z backwards
    spec.visual.global_.offwidth, spec.visual.global_.offheight = section.width, section.height


def _add_object(draft: Draft, obj: SceneObject) -> Any:
    body = draft.spec.worldbody.add_body(
        name=OBJECT + obj.name, pos=list(obj.path[0].at if obj.path else obj.at), quat=quat_of(obj.rpy)
    )
    if obj.movable or obj.soft:
        body.add_freejoint()
    for shape in obj.shapes:
        geom = body.add_geom(**shape.geom(draft.spec, draft.scene.folder))
        geom.rgba, geom.condim = [*obj.color, 1.0], 1
        geom.friction = [obj.friction, 0.005, 0.0001]
        if shape.kind == "soft":
            geom.density = shape.density
    return body


def _compiled(draft: Draft) -> Any:
    try:
        model = draft.spec.compile()
    except ValueError as error:
        raise ConfigError(
            f"cannot be built: {str(error).splitlines()[0]}.", field=draft.scene.name, hint="fix that object"
        ) from error
    for obj in draft.scene.movable:
        body = model.body(OBJECT + obj.name)
        body.inertia[:] *= (obj.mass or _MOVABLE_MASS) / float(body.mass[0])
        body.mass[:] = obj.mass or _MOVABLE_MASS
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _mounts(draft: Draft, model: Any) -> tuple[tuple[str, str], ...]:
    """Exclude contacts of the first moving link, which rotates in place, with fixed bodies that it overlaps at home."""
    if draft.robot is None:
        return ()
    fixed = [draft.bodies[t.name] for t in draft.scene.objects if t.name in draft.bodies and not (t.movable or t.path)]
    data = mujoco.MjData(model)
    data.qpos[robot_joints(model, draft.robot)[0]] = draft.scene.robot.home or draft.robot.home  # type: ignore[union-attr]
    mujoco.mj_kinematics(model, data)
    link = model.body(draft.robot_bodies[1].name)
    found = []
    if draft.map_geoms:
        fixed.append(draft.spec.worldbody)
    for body in fixed:
        if _overlap(model, data, link, model.body(body.name)):
            draft.spec.add_exclude(bodyname1=link.name, bodyname2=body.name)
            found.append((str(link.name), _owner(body.name)))
    return tuple(found)


def _overlap(model: Any, data: Any, a: Any, b: Any) -> bool:
    pairs = [(i, j) for i in _geoms(a) for j in _geoms(b)]
    return any(mujoco.mj_geomDistance(model, data, i, j, 1e-3, None) < 1e-3 for i, j in pairs)


def _geoms(body: Any) -> range:
    return range(int(body.geomadr[0]), int(body.geomadr[0]) + int(body.geomnum[0]))


def owners_of(model: Any) -> tuple[tuple[str, ...], NDArray[np.bool_]]:
    """Return the owner of each geom, and whether it belongs to the robot, as in :class:`World`."""
    names = [str(model.body(int(body)).name) for body in model.geom_bodyid]
    robot = np.array([not name.startswith(OBJECT) and name != "world" for name in names], dtype=np.bool_)
    return tuple(_owner(name) for name in names), robot


def _owner(body: str) -> str:
    return MAP if body == "world" else str(body).removeprefix(OBJECT)


def robot_joints(model: Any, robot: RobotModel) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices (J,) of the arm's joints in qpos, in the velocities, and among the actuators."""
    names: Sequence[str] = robot.chain.names
    joints = [model.joint(name) for name in names]
    qpos = np.array([int(j.qposadr[0]) for j in joints], dtype=np.int64)
    dofs = np.array([int(j.dofadr[0]) for j in joints], dtype=np.int64)
    acts = np.array([int(model.actuator(name).id) for name in names], dtype=np.int64)
    return qpos, dofs, acts


def gripper_joints(model: Any, robot: RobotModel) -> tuple[list[int], list[int], int]:
    """Return the indices of the fingers in qpos and in the velocities, and their actuator.

    Raises:
        InputError: the robot has no gripper.
    """
    if robot.gripper is None:
        raise InputError("has no gripper.", field=robot.name, hint="leave `opening` out of the moves")
    joints = [model.joint(f"finger{i}") for i in (1, 2)]
    return [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints], int(model.actuator("opening").id)
