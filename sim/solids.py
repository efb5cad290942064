"""Shapes of scene objects, and their MuJoCo geoms."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import mujoco
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from splatbot.errors import ConfigError
from splatbot.geometry import rotation_to_quat
from splatbot.protocols import Array

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class _Geom(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    geom_type: ClassVar[mujoco.mjtGeom]

    at: Vec3 = Field(default=(0.0, 0.0, 0.0), description="in the object's frame [m]")
    rpy: Vec3 = Field(default=(0.0, 0.0, 0.0), description="roll, pitch, yaw [rad]")

    def geom(self, spec: Any, folder: Path) -> dict[str, Any]:
        """Return the arguments of ``MjsBody.add_geom``."""
        size = [*self._sizes(), 0.0, 0.0][:3]
        return {"type": self.geom_type, "size": size, "pos": list(self.at), "quat": quat_of(self.rpy)}

    def _sizes(self) -> list[float]:
        """Return MuJoCo's sizes of the geom [m]."""
        raise NotImplementedError


class PlaneGeom(_Geom):
    """An infinite plane; its normal is z."""

    geom_type = mujoco.mjtGeom.mjGEOM_PLANE

    kind: Literal["plane"]

    def _sizes(self) -> list[float]:
        return [0.0, 0.0, 0.01]


class BoxGeom(_Geom):
    """A box; ``size`` is its length, width and height [m]."""

    geom_type = mujoco.mjtGeom.mjGEOM_BOX

    kind: Literal["box"]
    size: tuple[Positive, Positive, Positive]

    def _sizes(self) -> list[float]:
        return [s / 2 for s in self.size]


class SphereGeom(_Geom):
    """A sphere."""

    geom_type = mujoco.mjtGeom.mjGEOM_SPHERE

    kind: Literal["sphere"]
    radius: Positive

    def _sizes(self) -> list[float]:
        return [self.radius]


class _RoundGeom(_Geom):
    kind: str
    radius: Positive
    height: Positive

    def _sizes(self) -> list[float]:
        return [self.radius, self.height / 2]


class CylinderGeom(_RoundGeom):
    """A cylinder along z about its centre."""

    geom_type = mujoco.mjtGeom.mjGEOM_CYLINDER

    kind: Literal["cylinder"]


class CapsuleGeom(_RoundGeom):
    """A capsule along z about its centre; ``height`` is without the caps."""

    geom_type = mujoco.mjtGeom.mjGEOM_CAPSULE

    kind: Literal["capsule"]


class EllipsoidGeom(_Geom):
    """An ellipsoid with three half-axes [m]."""

    geom_type = mujoco.mjtGeom.mjGEOM_ELLIPSOID

    kind: Literal["ellipsoid"]
    axes: tuple[Positive, Positive, Positive]

    def _sizes(self) -> list[float]:
        return list(self.axes)


class MeshGeom(_Geom):
    """The convex hull of a mesh file (OBJ, STL), or of points (P, 3) [m]."""

    geom_type = mujoco.mjtGeom.mjGEOM_MESH

    kind: Literal["mesh"]
    file: str | None = None
    points: tuple[Vec3, ...] = ()
    scale: Positive = 1.0

    def geom(self, spec: Any, folder: Path) -> dict[str, Any]:
        """Add the mesh to ``spec`` and return the arguments of ``MjsBody.add_geom``."""
        name = f"mesh{len(list(spec.meshes))}"
        if self.file is not None:
            path = folder / self.file
            if not path.is_file():
                raise ConfigError(
                    "is not there.", file=path, field="mesh.file", hint="name it relative to the scene file"
                )
            spec.add_mesh(name=name, file=str(path.resolve()), scale=[self.scale] * 3)
        elif len(self.points) >= 4:
            spec.add_mesh(name=name, uservert=(self.scale * np.asarray(self.points)).ravel().tolist())
        else:
            raise ConfigError("has neither a file nor four points.", field="mesh", hint="give file or points")
        pose = {"pos": list(self.at), "quat": quat_of(self.rpy)}
        return {"type": self.geom_type, "meshname": name, **pose}


class SoftGeom(_Geom):
    """A box of elastic material.

    Args:
        size: [m].
        cells: nodes along each side; more nodes bend more finely and cost more.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: [kg/m³].
    """

    geom_type = mujoco.mjtGeom.mjGEOM_BOX

    kind: Literal["soft"]
    size: tuple[Positive, Positive, Positive]
    cells: tuple[int, int, int] = (4, 4, 4)
    young: Positive = 2e4
    poisson: Annotated[float, Field(ge=0, lt=0.5)] = 0.2
    density: Positive = 100.0

    def _sizes(self) -> list[float]:
        return [s / 2 for s in self.size]


Shape = Annotated[
    PlaneGeom | BoxGeom | SphereGeom | CylinderGeom | CapsuleGeom | EllipsoidGeom | MeshGeom | SoftGeom,
    Field(discriminator="kind"),
]


def rotation_of(rpy: Vec3) -> Array:
    """Compute the rotation (3, 3) Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def pose_at(at: Vec3, rpy: Vec3) -> Array:
    """Compute the pose (4, 4) with position ``at`` [m] and orientation ``rpy`` [rad]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(rpy), at
    return T


def quat_of(rpy: Vec3) -> list[float]:
    """Compute the quaternion wxyz of roll, pitch, yaw [rad]."""
    return [float(v) for v in rotation_to_quat(rotation_of(rpy))]


def rpy_of(R: Array) -> Vec3:
    """Compute roll, pitch, yaw [rad] of a rotation (3, 3), the inverse of :func:`rotation_of`.

    At a pitch of ±90 degrees roll and yaw have the same axis, and the roll is 0.
    """
    across = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = float(np.arctan2(-R[2, 0], across))
    if across < 1e-9:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))
