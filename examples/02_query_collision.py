"""Query a map for collisions: points, spheres, and configurations of a robot arm."""

import numpy as np

from splatbot import GaussianCollisionField, GaussianModel
from splatbot.collision import RobotSpheres
from splatbot.robots.panda import panda

# A wall of flat discs at x = 0.4 m: 4 mm apart, 1 mm thick.
y, z = (values.ravel() for values in np.meshgrid(np.arange(-0.5, 0.5, 0.004), np.arange(0.0, 1.0, 0.004)))
count = len(y)
wall = GaussianModel.from_activated(
    means=np.stack([np.full(count, 0.4), y, z], axis=1),
    quats=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
    scales=np.tile([0.001, 0.004, 0.004], (count, 1)),
    opacities=np.full(count, 0.9),
    colors=np.full((count, 3), 0.5),
)
field = GaussianCollisionField(wall, n_sigma=2.0)

points = np.array([[0.0, 0.0, 0.5], [0.4, 0.0, 0.5]])
for point, hit in zip(points, field.in_collision(points), strict=True):
    print(f"point {point}: {'in collision' if hit else 'free'}")

sphere = np.array([[0.3, 0.0, 0.5, 0.05]])  # x, y, z, radius [m]
result = field.clearance(sphere)
print(f"clearance of a 5 cm sphere 10 cm in front of the wall: {1e3 * result.distance[0]:.1f} mm")

robot = panda()
arm = RobotSpheres(robot)
verdict = arm.check(field, robot.home[None])
print(f"arm at home: {f'link {verdict.link[0]} in collision' if verdict.in_collision[0] else 'free'}")
