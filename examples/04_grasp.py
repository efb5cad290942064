"""Segment a map into objects, find a named one, and print the best grasps of a Panda."""

import numpy as np

from splatbot import GaussianModel
from splatbot.bench.tabletop import Block, Can, Tabletop
from splatbot.grasping.affordance import NameHint, find_target
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.sampler import GraspSampler
from splatbot.robots.panda import panda
from splatbot.segmentation import segment

table = Block((0.5, 0.0, -0.02), (0.7, 0.9, 0.04))
box = Block((0.45, 0.15, 0.06), (0.10, 0.06, 0.12), 0.4)
can = Can((0.50, -0.15, 0.0), 0.03, 0.12)
model = Tabletop((table, box, can)).gaussians(15_000)
points = model.means.double().numpy()
colors = np.full((len(points), 3), 0.6)
colors[np.abs(can.distance(points)) < 1e-4] = (0.1, 0.2, 0.8)  # a blue can
colors[np.abs(box.distance(points)) < 1e-4] = (0.8, 0.1, 0.1)  # a red box
model = GaussianModel.from_activated(
    means=points, quats=model.quats, scales=model.scales, opacities=model.opacities, colors=colors
)

scene = segment(model, np.eye(4))  # the robot base is the origin
print(f"{len(scene.objects)} objects on {len(scene.supports)} support")
target = find_target(NameHint("blue can"), scene, [LanguageAffordance()])
print(f"target: {target.label}, {len(target.rows)} Gaussians, found by {target.backend}")

result = GraspSampler(scene, panda()).sample(target)
for grasp in result.grasps[:3]:
    print(f"grasp of width {1e3 * grasp.width:.0f} mm, score {grasp.total:.2f}, closure {grasp.terms['closure']:.2f}")
