"""A pick on a recorded map: planned as on the robot, executed in the twin of that map before the robot moves."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import inverse, quat_to_rotation, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.attached import object_spheres
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOptions, PickResult, PickStage, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import GraspResult
from splatbot.planning.problem import link_words
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.contact_monitor import ClearanceMonitor, ContactEvent, ContactMonitor, MinimumClearance
from splatbot.sim.controller import TwinController
from splatbot.sim.effects.contact import ROBOT
from splatbot.sim.maps.ellipsoids import Ellipsoids, merge
from splatbot.sim.recording import TwinRecording
from splatbot.sim.scene import Clutter, Scene, SceneObject, SceneTask
from splatbot.sim.solids import rpy_of
from splatbot.sim.twin import Twin
from splatbot.sim.world import MAP, OBJECT, World


@dataclass(frozen=True)
class MapPickConstants:
    """Constants of picks in the twins of maps.

    Args:
        min_rise: share of the lift by which the target must rise.
        clearance_period: [s] time between clearance computations.
        ellipsoids: largest number of ellipsoids of the target.
        thickness: [m] standard deviation of a surface point of the target, which thickens its ellipsoids.
        inward: [m] half-axis of these ellipsoids across the surface, where the target is thick enough.
        ray_radius: [m] radius around the inward normal in which the opposite side is searched.
        shape_error: [m] depth to which the hand may touch the target on the approach, an error of the twin's shape.
        supports: cosine of the largest angle between the vertical and the normal of a contact that supports the target.
    """

    min_rise: float = 0.8
    clearance_period: float = 0.02
    ellipsoids: int = 200
    thickness: float = 5e-4
    inward: float = 5e-3
    ray_radius: float = 4e-3
    shape_error: float = 2e-3
    supports: float = 0.7


CONSTANTS = MapPickConstants()

_FINE = {"objects": False, "ellipsoids": 4000}  # primitives and coarse ellipsoids reach millimetres beyond the map

TARGET = "target"
"""Name of the target in the twin."""
_COLOR = (0.95, 0.5, 0.1)  # of the target in pictures


@dataclass(frozen=True, eq=False)
class MapPick:
    """Result of a pick in the twin of a map.

    Args:
        result: of the pick, with its certified motions.
        rose: height by which the target rose [m].
        wanted: height of the lift [m].
        contacts: unintended contacts: all but those of the hand with the target, of less than 2 mm before the closing.
        clearance: minimum clearance of the links before the hand from map and objects.
        recording: of the whole pick.
        notes: on the twin of the map.
    """

    result: PickResult
    rose: float
    wanted: float
    contacts: tuple[ContactEvent, ...]
    clearance: MinimumClearance
    recording: TwinRecording
    notes: tuple[str, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the reasons for which the pick should not be executed; empty if it should."""
        found = [] if self.result else [f"{self.result.outcome}: {self.result.reason}"]
        found += [
            f"{self.words(contact.part)} touches {self.words(contact.other)} at {contact.first:.2f} s, "
            f"{1e3 * contact.depth:.1f} mm deep"
            for contact in self.contacts
        ]
        if self.result and self.rose < CONSTANTS.min_rise * self.wanted:
            found.append(f"the target rose by {1e3 * self.rose:.0f} mm of {1e3 * self.wanted:.0f} mm")
        return tuple(found)

    def words(self, part: str) -> str:
        """Return the words for a part of the arm, as causes of plans name links; other names stay."""
        robot = self.recording.world.robot
        if robot is None or not re.fullmatch(r"link\d+", part):
            return part
        link = int(part.removeprefix("link"))
        return link_words(link, robot.chain.names[link - 1] if link > 0 else "")

    @property
    def outcome(self) -> str:
        """Return the verdict on the whole pick in words: that of the pick, or that of physics after it."""
        if not self.result or not self.problems:
            return str(self.result.outcome)
        return "touched" if self.contacts else "not lifted"

    def __bool__(self) -> bool:
        return not self.problems


def twin_of_pick(scene: Scene, robot: RobotModel, sampler: GraspSampler, target: Target, *, seed: int = 0) -> Twin:
    """Build the twin of a map in which the target is a movable object: ellipsoids on its completed surface.

    Args:
        scene: the map in the frame of the robot's base; see :func:`splatbot.sim.maps.placed.placed_scene`.
        robot: the arm.
        sampler: of the map.
        target: the target.
        seed: of small displacements of the target; 0 for none.

    Raises:
        InputError: the scene has no map.
    """
    if scene.map is None:
        raise InputError("has no map.", field=scene.name, hint="give the scene of a map")
    twin = Twin(_with_target(scene, scene.map, sampler, target), robot=robot, seed=seed)
    _detach_target(twin)
    return twin


def pick_on_map(
    twin: Twin,
    sampler: GraspSampler,
    target: Target,
    grasps: GraspResult,
    options: PickOptions,
    *,
    start: Array,
    on_step: Callable[[PickStep], None] | None = None,
    watch: Callable[[Any, float], None] | None = None,
) -> MapPick:
    """Plan a pick on a map, and execute it in the twin of that map.

    1. :class:`splatbot.grasping.pick.Picker` plans, certifies and executes the pick, as on a robot.
    2. The target rests as in the map until the fingers press on it, because the frames show it at rest. From then on
       only friction holds it.
    3. Contacts and clearance of the arm, and the height of the target, are measured in physics.

    Args:
        twin: from :func:`twin_of_pick`.
        sampler: of the map; its certified margins and obstacles apply.
        target: the target.
        grasps: grasps of it, best first.
        options: of the pick.
        start: (J,) configuration at which the pick begins [rad or m].
        on_step: called after each stage.
        watch: called with MuJoCo's data and the time [s] after every control period, as a video.

    Raises:
        InputError: the robot has no fingers.
    """
    held = _HeldStill(twin)
    twin.reset(start)
    monitor = _Monitor(twin, watch)
    controller = TwinController(twin, watch=monitor)
    if controller.gripper is None:
        raise InputError("has no fingers.", field=twin.scene.name, hint="take a robot with a gripper")

    def after(step: PickStep) -> None:
        if step.stage is PickStage.APPROACH:
            monitor.closing = monitor.time
            held.loosen()
        elif step.stage is PickStage.CLOSE:
            held.release()
        if on_step is not None:
            on_step(step)

    body = twin.data.body(OBJECT + TARGET)
    before = float(body.xipos[2])
    picker = Picker(sampler, controller, controller.gripper, options=options, on_step=after)
    result = picker.pick(target, grasps=grasps)
    return MapPick(
        result,
        float(body.xipos[2]) - before,
        options.lift,
        tuple(monitor.contacts.found),
        monitor.clearance.minimum,
        monitor.recording,
        twin.world.notes,
    )


class _Monitor:
    """Records contacts, clearance and poses in every control period."""

    def __init__(self, twin: Twin, further: Callable[[Any, float], None] | None) -> None:
        self._hand = hand_parts(twin.world)
        self.contacts = ContactMonitor(twin.world, expected=self._expected)
        self.clearance = ClearanceMonitor(twin.world, without=self._hand)
        self.recording, self._further = TwinRecording(twin.world, expected=self._expected), further
        self._due = self.time = 0.0
        self.closing = np.inf

    def __call__(self, data: Any, time: float) -> None:
        self.time = time
        self.contacts.update(data, time)
        if time >= self._due:
            self.clearance.update(data, time)
            self._due = time + CONSTANTS.clearance_period
        self.recording(data, time)
        if self._further is not None:
            self._further(data, time)

    def _expected(self, part: str, other: str, depth: float, time: float) -> bool:
        """Expect the hand to touch the target: from the closing on, or before it within the error of its shape."""
        return other == TARGET and part in self._hand and (time > self.closing or depth <= CONSTANTS.shape_error)


def hand_parts(world: World) -> frozenset[str]:
    """Return the names of the parts of the hand: the fingers, and the link that carries them."""
    if world.robot is None or world.robot.gripper is None:
        return frozenset()
    model = world.model
    fingers = [int(model.joint(f"finger{i}").bodyid[0]) for i in (1, 2)]
    parts = (*fingers, *(int(model.body_parentid[finger]) for finger in fingers))
    return frozenset(str(model.body(part).name) for part in parts)


def _with_target(scene: Scene, clutter: Clutter, sampler: GraspSampler, target: Target) -> Scene:
    """Replace the target's Gaussians in a scene by a movable object."""
    T_base_world = inverse(sampler.scene.T_world_base)
    surface = sampler.surface(target)
    balls = object_spheres(surface)
    points = transform_points(T_base_world, surface.points)
    parts = solid_shell(points, surface.normals @ T_base_world[:3, :3].T)
    middle = points.mean(axis=0)
    shapes = [
        {"kind": "ellipsoid", "at": at, "axes": axes, "rpy": rpy_of(R)}
        for at, axes, R in zip(
            (parts.centers - middle).tolist(), parts.axes.tolist(), quat_to_rotation(parts.quats), strict=True
        )
    ]
    values = {"name": TARGET, "shapes": shapes, "at": middle.tolist(), "movable": True, "color": _COLOR}
    without = [tuple(ball) for ball in np.c_[transform_points(T_base_world, balls[:, :3]), balls[:, 3]].tolist()]
    return scene.model_copy(
        update={
            "map": clutter.model_copy(update=_FINE | {"without": tuple(without)}),
            "objects": (*scene.objects, SceneObject.model_validate(values)),
            "task": SceneTask(kind="grasp"),
        }
    )


def solid_shell(points: Array, normals: Array) -> Ellipsoids:
    """Cover a surface by ellipsoids that reach inwards, so that fingers do not press through it.

    1. Points merge to flat ellipsoids, as the Gaussians of a map do. They overlap, and reach up to 4 mm beyond an edge;
       smaller ones taper there, so that fingers at a rim squeeze the target out.
    2. Each ellipsoid grows inwards by 5 mm, or to half of the object's thickness there. Its outer side stays in place.

    Args:
        points: (P, 3) on the surface [m].
        normals: (P, 3) outward unit normals.
    """
    flat = np.broadcast_to(np.eye(3) * CONSTANTS.thickness**2, (len(points), 3, 3))
    parts = merge(points, flat, np.ones(len(points)), points.mean(axis=0), CONSTANTS.ellipsoids)
    across = quat_to_rotation(parts.quats)[:, :, 0]  # the shortest axis
    to_point = points[None] - parts.centers[:, None]
    outward = normals[np.linalg.norm(to_point, axis=2).argmin(axis=1)]
    across = across * np.where(np.einsum("ej,ej->e", across, outward) < 0.0, -1.0, 1.0)[:, None]
    depth = -np.einsum("epj,ej->ep", to_point, across)
    aside = np.linalg.norm(to_point + depth[:, :, None] * across[:, None], axis=2)
    opposite = (aside < CONSTANTS.ray_radius) & (depth > CONSTANTS.thickness) & (across @ normals.T < 0.0)
    thickness = np.where(opposite, depth, np.inf).min(axis=1)
    half = np.maximum(np.minimum(CONSTANTS.inward, thickness / 2), parts.axes[:, 0])
    centers = parts.centers - (half - parts.axes[:, 0])[:, None] * across
    return replace(parts, centers=centers, axes=np.c_[half, parts.axes[:, 1:]])


def _detach_target(twin: Twin) -> None:
    """Let the target pass the clutter that its fitted shape overlaps from the side or from above.

    Shapes of neighbours overlap by millimetres, and contact would push the target away before the pick. Clutter below
    the target still supports it, and the arm still touches all clutter.
    """
    model, data, world = twin.world.model, twin.data, twin.world
    body = data.body(OBJECT + TARGET)
    for k in range(int(data.ncon)):
        contact = data.contact[k]
        pair = [int(geom) for geom in contact.geom]
        owners = [world.owner[geom] for geom in pair]
        if TARGET not in owners or MAP not in owners:
            continue
        below = contact.pos[2] < body.xipos[2] and abs(contact.frame[2]) > CONSTANTS.supports
        if not below:
            clutter = pair[owners.index(MAP)]
            model.geom_contype[clutter], model.geom_conaffinity[clutter] = 0, ROBOT


class _HeldStill:
    """Keeps the target at rest by damping of its joint [N s/m, N m s].

    Before the closing a weight of 2 N moves it by 2 µm a second. While the fingers close, they centre the object as on
    a table: at 0.1 m/s it resists with 20 N.
    """

    _AT_REST, _PUSHED = np.full((6, 1), 1e6), np.array([200.0] * 3 + [2.0] * 3)[:, None]

    def __init__(self, twin: Twin) -> None:
        model = twin.world.model
        first = int(model.body(OBJECT + TARGET).dofadr[0])
        self._damping = np.asarray(model.dof_damping).reshape(model.nv, -1)[first : first + 6, :1]
        self._before = self._damping.copy()
        self._damping[:] = self._AT_REST

    def loosen(self) -> None:
        """Let fingers push the target."""
        self._damping[:] = self._PUSHED

    def release(self) -> None:
        """Let the target move."""
        self._damping[:] = self._before
