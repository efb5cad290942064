"""Reader of an arm from a MuJoCo model (MJCF), as those of MuJoCo Menagerie."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from splatbot.errors import FormatError, InputError
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.robots.joints import Joint
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.maker_meshes import as_shapes
from splatbot.robots.reading import CONSTANTS, NamedShape, Reading, checked_slack, default_tip, distinct, joint, z_to
from splatbot.robots.robot import Inertial, RobotModel
from splatbot.robots.shapes import Box, Capsule

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_HOME = "home"


def read_mjcf(path: str | Path, *, tip: str | None = None, slack: float | None = None) -> Reading:
    """Read the serial arm from the world to ``tip``.

    The base is the body that carries the first moving joint's body. Bodies without a joint belong to the link that
    carries them, and moving joints outside the arm stay at the model's reference posture. All geoms are shapes of
    their links, visual ones too. The keyframe "home" is the home posture. The names of bodies are those of links in TF.

    Args:
        path: MJCF file.
        tip: last body, or a site, of the arm. If None, see :func:`splatbot.robots.reading.default_tip`.
        slack: see :class:`splatbot.robots.robot.RobotModel` [m]. If None, 2 % of the reach.

    Raises:
        FormatError: MuJoCo refuses the file, or the model has no such arm.
    """
    file = Path(path)
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise FormatError(f"cannot be read: {error}.", file=file, hint="give an MJCF file that MuJoCo opens") from error
    return _MjcfReader(file, model, slack).read(tip)


class _MjcfReader:
    def __init__(self, file: Path, model: mujoco.MjModel, slack: float | None) -> None:
        self.file, self.model, self.slack = file, model, slack
        self.data = mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        self.notes: list[str] = []

    def read(self, tip: str | None) -> Reading:
        end, T_world_tcp = self._end(tip)
        path = self._path(end)
        numbers = [j for body in path for j in self._joints(body)]
        if not numbers:
            raise FormatError("has no moving joint.", file=self.file, field=self._name(end), hint="name another --tip")
        first = int(self.model.jnt_bodyid[numbers[0]])
        bodies = [int(self.model.body_parentid[first]), *(int(self.model.jnt_bodyid[j]) for j in numbers)]
        T_world_base = self._pose(bodies[0])
        # The frame of link k at the reference posture: origin at the anchor of its joint, z along the axis.
        frames = [T_world_base, *(self._joint_frame(j) for j in numbers)]
        before = [inverse(a) @ b for a, b in itertools.pairwise(frames)]
        joints = [self._joint(j, T) for j, T in zip(numbers, before, strict=True)]
        link_of = self._links(path, numbers)
        T_link_world = [inverse(T) for T in frames]
        named = distinct(shape for body, k in link_of.items() for shape in self._shapes(body, k, T_link_world[k]))
        T_link_tcp = T_link_world[-1] @ T_world_tcp
        slack = checked_slack(named, joints, T_link_tcp, self.slack, self.file)
        robot = RobotModel(
            name=self._model_name(),
            joints=tuple(joints),
            shapes=tuple(shape.shape for shape in named),
            T_link_tcp=T_link_tcp,
            home=self._home(numbers, joints),
            inertials=self._inertials(link_of, T_link_world),
            slack=slack,
            link_frames=self._link_frames(bodies, frames),
        )
        self.notes.append(f"MJCF has no limits of velocity: {CONSTANTS.velocity:g} per second is assumed")
        return Reading(robot, tuple(self.notes))

    def _link_frames(self, bodies: list[int], frames: list[Array]) -> LinkFrames | None:
        """Return the places of the links (J + 1, 4, 4) [m] in their bodies; None if bodies do not name each link."""
        names = tuple(str(self.model.body(body).name) for body in bodies)
        if not all(names) or len(set(names)) < len(names):
            self.notes.append("TF cannot mask the robot: a body of the arm has no name, or two joints")
            return None
        placed = [inverse(self._pose(body)) @ T for body, T in zip(bodies, frames, strict=True)]
        return LinkFrames(names, np.stack(placed))

    def _end(self, tip: str | None) -> tuple[int, Array]:
        """Return the last body of the arm, and the pose T_world_tcp (4, 4) [m]."""
        m = self.model
        if tip is None:
            name = {body: str(body) for body in range(m.nbody)}
            children: dict[str, list[str]] = {}
            for body in range(1, m.nbody):
                children.setdefault(name[int(m.body_parentid[body])], []).append(name[body])
            moving = [name[body] for body in range(1, m.nbody) if self._joints(body)]
            end = int(default_tip(children, moving, name[0], self.file))
            sites = [s for s in range(m.nsite) if m.site_bodyid[s] == end]
            if len(sites) == 1:
                self.notes.append(f"the tool frame is the site {m.site(sites[0]).name!r}")
                return end, self._site(sites[0])
            return end, self._pose(end)
        body = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, tip)
        if body >= 0:
            return int(body), self._pose(int(body))
        site = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_SITE, tip)
        if site < 0:
            bodies = ", ".join(self._name(b) for b in range(1, m.nbody))
            raise FormatError(f"there is no body or site {tip!r}.", file=self.file, hint=f"bodies: {bodies}")
        return int(m.site_bodyid[site]), self._site(int(site))

    def _path(self, body: int) -> list[int]:
        """Return the bodies from the world's child to a body."""
        found = []
        while body > 0:
            found.append(body)
            body = int(self.model.body_parentid[body])
        return found[::-1]

    def _joints(self, body: int) -> list[int]:
        start, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return [j for j in range(start, start + count) if int(self.model.jnt_type[j]) in (_HINGE, _SLIDE)]

    def _joint_frame(self, j: int) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = z_to(self.data.xaxis[j]), self.data.xanchor[j]
        return T

    def _joint(self, j: int, T: Array) -> Joint:
        m, name = self.model, self._joint_name(j)
        prismatic = int(m.jnt_type[j]) == _SLIDE
        reference = float(m.qpos0[m.jnt_qposadr[j]])
        at_zero = np.eye(4)  # the model's geometry is that of the reference posture
        if prismatic:
            at_zero[2, 3] = -reference
        else:
            c, s = np.cos(reference), np.sin(reference)
            at_zero[:2, :2] = [[c, s], [-s, c]]
        if m.jnt_limited[j]:
            low, high = (float(x) for x in m.jnt_range[j])
        elif prismatic:
            raise FormatError("has no limits of position.", file=self.file, field=name, hint="give it a range")
        else:
            low, high = -2 * np.pi, 2 * np.pi
            self.notes.append(f"{name} turns without end: limited to two turns")
        try:
            return joint(name, T @ at_zero, (low, high), CONSTANTS.velocity, self._effort(j), prismatic=prismatic)
        except InputError as error:
            raise FormatError(error.message, file=self.file, field=name, hint=error.hint) from error

    def _effort(self, j: int) -> float:
        """Return the largest force or torque of the joint or its actuators; 0 if it is unknown."""
        m = self.model
        if m.jnt_actfrclimited[j]:
            return float(np.abs(m.jnt_actfrcrange[j]).max())
        driven = [
            a
            for a in range(m.nu)
            if int(m.actuator_trntype[a]) == int(mujoco.mjtTrn.mjTRN_JOINT)
            and m.actuator_trnid[a, 0] == j
            and m.actuator_forcelimited[a]
        ]
        return max((float(np.abs(m.actuator_forcerange[a] * m.actuator_gear[a, 0]).max()) for a in driven), default=0.0)

    def _links(self, path: list[int], numbers: list[int]) -> dict[int, int]:
        """Return the link of each body that the arm carries, and of the bodies that are fixed to its base."""
        m, link_of = self.model, dict[int, int]()
        arm, first = set(path), path.index(int(m.jnt_bodyid[numbers[0]]))
        base = path[first - 1] if first > 0 else 0
        for body in range(1, m.nbody):
            parent = int(m.body_parentid[body])
            if body in arm:
                done = sum(int(m.jnt_bodyid[j]) == body for j in numbers)
                if done or body == base or parent in link_of:
                    link_of[body] = link_of.get(parent, 0) + done
            elif parent in link_of or (parent == base and base > 0):
                link_of[body] = link_of.get(parent, 0)
        return link_of

    def _shapes(self, body: int, k: int, T_link_world: Array) -> list[NamedShape]:
        start, count = int(self.model.body_geomadr[body]), int(self.model.body_geomnum[body])
        return [shape for g in range(start, start + count) for shape in self._shape(g, body, k, T_link_world)]

    def _shape(self, g: int, body: int, k: int, T_link_world: Array) -> list[NamedShape]:
        m, kind, name = self.model, mujoco.mjtGeom(int(self.model.geom_type[g])), self._name(body)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.geom_xmat[g].reshape(3, 3), self.data.geom_xpos[g]
        T = T_link_world @ T
        x, y, z = (float(v) for v in m.geom_size[g])
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            return [NamedShape(name, Capsule(k, _point(T), _point(T), x))]
        if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
            # A cylinder that is longer than wide lies in the capsule of its axis, others in their box.
            if kind == mujoco.mjtGeom.mjGEOM_CYLINDER and y <= x:
                return [NamedShape(name, Box(k, T, (2 * x, 2 * x, 2 * y)))]
            ends = transform_points(T, np.array([[0, 0, -y], [0, 0, y]]))
            return [NamedShape(name, Capsule(k, tuple(ends[0]), tuple(ends[1]), x))]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            return [NamedShape(name, Box(k, T, (2 * x, 2 * y, 2 * z)))]
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return [NamedShape(name, Box(k, T, (2 * x, 2 * y, 2 * z)))]  # which encloses it
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            return self._mesh(int(m.geom_dataid[g]), name, k, T)
        raise FormatError(
            f"has a geom of type {kind.name.removeprefix('mjGEOM_').lower()}.",
            file=self.file, field=name, hint="use spheres, capsules, cylinders, boxes, ellipsoids, meshes",
        )  # fmt: skip

    def _mesh(self, number: int, name: str, k: int, T: Array) -> list[NamedShape]:
        m = self.model
        vertices = slice(m.mesh_vertadr[number], m.mesh_vertadr[number] + m.mesh_vertnum[number])
        faces = slice(m.mesh_faceadr[number], m.mesh_faceadr[number] + m.mesh_facenum[number])
        at = transform_points(T, m.mesh_vert[vertices].astype(np.float64))
        return [
            NamedShape(f"{name} ({m.mesh(number).name})", mesh)
            for mesh in as_shapes(at, m.mesh_face[faces].astype(np.int64), k)
        ]

    def _home(self, numbers: list[int], joints: list[Joint]) -> Array:
        m = self.model
        key = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_KEY, _HOME)
        posture = m.key_qpos[key] if key >= 0 else np.zeros(m.nq)
        q = np.array([posture[m.jnt_qposadr[j]] for j in numbers], dtype=np.float64)
        return np.clip(q, [j.lower for j in joints], [j.upper for j in joints])

    def _inertials(self, link_of: dict[int, int], T_link_world: list[Array]) -> tuple[Inertial, ...]:
        parts: list[list[tuple[float, Array, Array]]] = [[] for _ in T_link_world]
        for body, k in link_of.items():
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = self.data.ximat[body].reshape(3, 3), self.data.xipos[body]
            T = T_link_world[k] @ T
            R = T[:3, :3]
            parts[k].append(
                (float(self.model.body_mass[body]), T[:3, 3], R @ np.diag(self.model.body_inertia[body]) @ R.T)
            )
        if any(sum(mass for mass, _, _ in own) <= 0 for own in parts[1:]):
            self.notes.append("some moving links have no mass: the twin cannot be built from it")
            return ()
        return tuple(Inertial.summed(own) for own in parts)

    def _pose(self, body: int) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        return T

    def _site(self, site: int) -> Array:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.data.site_xmat[site].reshape(3, 3), self.data.site_xpos[site]
        return T

    def _name(self, body: int) -> str:
        return str(self.model.body(body).name) or f"body {body}"

    def _joint_name(self, j: int) -> str:
        return str(self.model.joint(j).name) or f"joint{j + 1}"

    def _model_name(self) -> str:
        names: Any = self.model.names
        return bytes(names).split(b"\0", 1)[0].decode() or self.file.stem


def _point(T: Array) -> tuple[float, float, float]:
    return float(T[0, 3]), float(T[1, 3]), float(T[2, 3])
