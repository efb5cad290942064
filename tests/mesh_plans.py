"""Fresh plans of the Panda, checked with the meshes of its maker against the true shapes of the scene.

Run `python -m tests.mesh_plans --count 1000`. It requires python-fcl. The planner sees Gaussians of the scene and the
arm's spheres. The check sees neither: it moves Franka's visual and collision meshes along the timed curve.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatbot.bench.planning_problems import problems
from splatbot.bench.tabletop import Ball, Block, Can, Solid, Tabletop
from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.fcl_models import fcl_mesh
from splatbot.geometry import so3_exp
from splatbot.planning import GaussianRRTStar, time_path
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.sources import SOURCES
from tests.attacks.command_line import exit_code, seeded_parser

PER_SCENE = 25  # problems
BUDGET_MS = 28.0
STEP = 0.01  # [rad] between checked configurations, at most
OPEN = 0.04  # [m] of each finger
GAUSSIANS = 20_000
SLIVER = 1e-5  # [m] height below which a triangle is left out; its neighbours have its corners
_TABLE = Block((0.625, 0.0, -0.02), (0.95, 1.8, 0.04))


def _object(rng: np.random.Generator, x: float, y: float) -> Solid:
    kind, height = rng.integers(3), float(rng.uniform(0.06, 0.28))
    if kind == 0:
        size = (float(rng.uniform(0.05, 0.14)), float(rng.uniform(0.05, 0.14)), height)
        return Block((x, y, height / 2), size, float(rng.uniform(0, 3)))
    if kind == 1:
        return Can((x, y, 0.0), float(rng.uniform(0.02, 0.06)), height)
    radius = float(rng.uniform(0.03, 0.08))
    return Ball((x, y, radius), radius)


def _scattered(rng: np.random.Generator, count: int) -> list[Solid]:
    return [_object(rng, float(rng.uniform(0.3, 0.85)), float(rng.uniform(-0.6, 0.6))) for _ in range(count)]


def clutter(rng: np.random.Generator) -> Tabletop:
    """Build a table with twelve objects."""
    return Tabletop((_TABLE, *_scattered(rng, 12)))


def shelf(rng: np.random.Generator) -> Tabletop:
    """Build a shelf of two boards on a table, with objects."""
    y, x = float(rng.uniform(-0.4, 0.4)), float(rng.uniform(0.55, 0.7))
    boards: list[Solid] = [Block((x, y + side, 0.25), (0.3, 0.02, 0.5)) for side in (-0.3, 0.3)]
    boards += [Block((x, y, z), (0.3, 0.6, 0.02)) for z in (0.26, 0.5)]
    return Tabletop((_TABLE, *boards, *_scattered(rng, 5)))


def crate(rng: np.random.Generator) -> Tabletop:
    """Build an open box on a table, with objects."""
    y, x = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.5, 0.6))
    walls: list[Solid] = [Block((x + side, y, 0.1), (0.02, 0.5, 0.2)) for side in (-0.2, 0.2)]
    walls += [Block((x, y + side, 0.1), (0.4, 0.02, 0.2)) for side in (-0.25, 0.25)]
    return Tabletop((_TABLE, *walls, *_scattered(rng, 5)))


def columns(rng: np.random.Generator) -> Tabletop:
    """Build a table with eight thin columns."""
    at = zip(rng.uniform(0.35, 0.8, 8), rng.uniform(-0.6, 0.6, 8), strict=True)
    return Tabletop((_TABLE, *(Can((float(x), float(y), 0.0), 0.015, 0.6) for x, y in at)))


SCENES: dict[str, Callable[[np.random.Generator], Tabletop]] = {
    "clutter": clutter,
    "shelf": shelf,
    "bin": crate,
    "columns": columns,
}


@dataclass
class Tally:
    """Counts by kind of scene, and descriptions of the contacts."""

    plans: Counter[str] = field(default_factory=Counter)
    solved: Counter[str] = field(default_factory=Counter)
    contacts: list[str] = field(default_factory=list)
    configurations: int = 0


class MeshedPanda:
    """The maker's meshes of all moving parts, for fcl."""

    def __init__(self) -> None:
        self.fcl: Any = importlib.import_module("fcl")
        self.robot = panda()
        source = SOURCES["panda"]
        self.parts: list[tuple[str, int, Array, Any]] = []  # name, link, pose on the link, fcl object
        for k in range(1, 8):
            self._add(source.shapes(f"link{k}"), f"link{k}", k, np.eye(4))
        assert self.robot.gripper is not None
        hand = np.eye(4)
        hand[:3, :3], hand[2, 3] = so3_exp([0.0, 0.0, -np.pi / 4]), 0.107
        self._add(source.shapes("hand"), "hand", 7, hand)
        for T, name in zip(self.robot.gripper.T_link_finger, ("left finger", "right finger"), strict=True):
            out = np.eye(4)
            out[1, 3] = OPEN
            self._add(source.shapes("finger"), name, 7, T @ out)

    def _add(self, shapes: Any, name: str, link: int, T: Array) -> None:
        """Add a part without slivers, for which fcl reports contacts with spheres that are centimetres away."""
        for shape in shapes:
            triangles = shape.triangles()
            edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
            normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            triangles = triangles[np.linalg.norm(normals, axis=1) > SLIVER * edges]  # the height, as area / edge
            corners = triangles.reshape(-1, 3)
            model = fcl_mesh(corners, np.arange(len(corners)).reshape(-1, 3))
            self.parts.append((name, link, T, self.fcl.CollisionObject(model)))

    def contacts(self, q: Array, world: Any) -> set[str]:
        """Return the names of the parts that touch the world at configurations (C, 7)."""
        found = set()
        for T_base_link in self.robot.fk(q):
            for name, link, T, thing in self.parts:
                pose = T_base_link[link] @ T
                thing.setTransform(self.fcl.Transform(pose[:3, :3], pose[:3, 3]))
                data = self.fcl.CollisionData()
                world.collide(thing, data, self.fcl.defaultCollisionCallback)
                if data.result.is_collision:
                    found.add(name)
        return found

    def world(self, scene: Tabletop) -> Any:
        """Return a manager of the true shapes."""
        manager = self.fcl.DynamicAABBTreeCollisionManager()
        things = []
        for solid in scene.solids:
            if isinstance(solid, Block):
                shape, pose = self.fcl.Box(*solid.size), (so3_exp([0.0, 0.0, solid.yaw]), np.array(solid.center))
            elif isinstance(solid, Can):
                middle = np.array(solid.foot) + np.array([0.0, 0.0, solid.height / 2])
                shape, pose = self.fcl.Cylinder(solid.radius, solid.height), (np.eye(3), middle)
            elif isinstance(solid, Ball):
                shape, pose = self.fcl.Sphere(solid.radius), (np.eye(3), np.array(solid.center))
            else:
                raise TypeError(f"{type(solid).__name__} has no shape of fcl")
            things.append(self.fcl.CollisionObject(shape, self.fcl.Transform(*pose)))
        manager.registerObjects(things)
        manager.setup()
        return manager


def run(count: int, seed: int) -> Tally:
    """Plan in scenes of all kinds in turn, and check every timed curve."""
    tally, meshes, rng = Tally(), MeshedPanda(), np.random.default_rng(seed)
    while sum(tally.plans.values()) < count:
        for name, build in SCENES.items():
            scene = build(rng)
            gaussians = GaussianCollisionField(scene.gaussians(GAUSSIANS, seed=int(rng.integers(1 << 30))))
            planner, world = GaussianRRTStar(gaussians, panda()), meshes.world(scene)
            arm = RobotSpheres(panda())
            for problem in problems(panda(), arm, gaussians, Truth(scene), PER_SCENE, int(rng.integers(1 << 30))):
                tally.plans[name] += 1
                answer = planner.plan(problem.start, problem.goal, iterations=100_000, budget_ms=BUDGET_MS)
                if answer.path is None:
                    continue
                tally.solved[name] += 1
                timed = time_path(answer.path, planner.arm, gaussians)
                steps = int(np.ceil(timed.duration * panda().chain.velocity.max() / STEP))
                q = np.array([timed.reference(t)[0] for t in np.linspace(0.0, timed.duration, steps)])
                tally.configurations += len(q)
                if touched := meshes.contacts(q, world):
                    tally.contacts.append(f"{name}, plan {tally.plans[name]}: {', '.join(sorted(touched))}")
    return tally


def main() -> None:
    """Print the counts, and fail if a mesh touches a shape."""
    arguments = seeded_parser(__doc__, 1000).parse_args()
    tally = run(arguments.count, arguments.seed)
    for name, plans in tally.plans.items():
        print(f"{name}: {plans} plans, {tally.solved[name]} solved within {BUDGET_MS:g} ms")
    total = sum(tally.plans.values())
    share = 100 * sum(tally.solved.values()) / total
    print(f"{total} plans, {share:.1f} % solved; {tally.configurations} configurations, {len(tally.contacts)} contacts")
    raise SystemExit(exit_code(tally.contacts))


if __name__ == "__main__":
    main()
