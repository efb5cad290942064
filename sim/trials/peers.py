"""Two other stacks on the same frames and poses: a mesh of fused depth, and a point cloud in an octree."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.collision.fcl_models import fcl_mesh, fcl_octree, octomap_bytes
from splatbot.collision.visibility import measured_depths
from splatbot.evaluation.depth_fusion import DepthFusion
from splatbot.grasping.affordance import Target
from splatbot.grasping.pick_planner import PickPlanner
from splatbot.grasping.sampler import GraspSampler
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.segmentation import segment
from splatbot.sim.scan import discs
from splatbot.sim.trials.scan import FARTHEST, TrialScan, usable_depth
from splatbot.sim.trials.solid import SolidPickPlanner, SolidReach, SolidWorld
from splatbot.sim.trials.stacks import OPTIONS, StackMap

VOXEL = 0.004  # [m] of the distance field and of the cloud
LEAF = 0.01  # [m] of the octree
_OBSERVER_DISTANCE = 0.5  # [m] along the normal from a surface to its assumed observer
_GREY = 0.6  # of the mesh, whose colours are not used
_SEE_THROUGH = 0.03  # [m] measured depth behind a point that contradicts it
_NORMALS = 0.012, 24  # [m] radius and number of neighbours of a normal estimate
_MIN_NEIGHBOURS = 3  # points with fewer are outliers
_NODE, _LEAF_NODE = 256, 16  # [bytes] of FCL's BVNode<OBBRSS>, as measured, and of OctoMap's OcTreeNode
_SINGLE = 2  # ratio of float64 to float32, in which coordinates could be stored


class MeshStack:
    """TSDF fusion, marching cubes, and python-fcl on the triangles."""

    name = "mesh"

    def learn(self, scan: TrialScan) -> StackMap:
        """Implement :meth:`splatbot.sim.trials.stacks.Stack.learn`."""
        begin = time.perf_counter()
        fusion = DepthFusion(VOXEL, FARTHEST)
        for view in scan.views:
            fusion.add(*view)
        mesh = fusion.mesh()
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
        normals = np.asarray(mesh.vertex_normals)

        def around(rows: NDArray[np.int64]) -> Any:
            own = np.zeros(len(vertices), np.bool_)
            own[rows] = True
            return fcl_mesh(vertices, triangles[~own[triangles].any(axis=1)])

        world = SolidWorld(vertices, fcl_mesh(vertices, triangles), around)
        size = vertices.nbytes // _SINGLE + triangles.nbytes + 2 * len(triangles) * _NODE
        return _stack_map(scan, vertices, normals, np.full_like(vertices, _GREY), world, size, begin)


class CloudStack:
    """Points with normals, and python-fcl on an octree of them."""

    name = "cloud"

    def learn(self, scan: TrialScan) -> StackMap:
        """Implement :meth:`splatbot.sim.trials.stacks.Stack.learn`."""
        begin = time.perf_counter()
        cloud = _cloud(scan)
        points, normals, colors = (np.asarray(x) for x in (cloud.points, cloud.normals, cloud.colors))

        def around(rows: NDArray[np.int64]) -> Any:
            return fcl_octree(np.delete(points, rows, axis=0), LEAF)

        world = SolidWorld(points, fcl_octree(points, LEAF), around)
        voxels = len(np.unique(np.floor(points / LEAF).astype(np.int64), axis=0))
        nodes = voxels + len(octomap_bytes(points, LEAF)) // 2  # each inner node takes two bytes
        size = (points.nbytes + normals.nbytes) // _SINGLE + nodes * _LEAF_NODE
        return _stack_map(scan, points, normals, colors, world, size, begin)


def _stack_map(
    scan: TrialScan, points: Array, normals: Array, colors: Array, world: SolidWorld, size: int, begin: float
) -> StackMap:
    """Convert the surface to discs for segmentation and grasps, with the solid world for the arm."""
    scene = segment(discs(points, normals, colors, VOXEL), scan.T_world_base, cut=False)
    robot = panda()

    def planners(target: Target) -> tuple[GraspSampler, PickPlanner]:
        reach = SolidReach(robot, scene.T_world_base, world, target.rows)
        observers = points + _OBSERVER_DISTANCE * normals
        sampler = GraspSampler(
            scene, robot, observers=observers, views=scan.views, make_reach=lambda around, whole: reach
        )
        return sampler, SolidPickPlanner(sampler, target, OPTIONS, world)

    return StackMap(scene, planners, size, time.perf_counter() - begin)


def _cloud(scan: TrialScan) -> Any:
    """Average the points over voxels, without outliers and points that later frames contradict."""
    whole = o3d.geometry.PointCloud()
    for frame, T in scan.tracked:
        depth = usable_depth(frame)
        part = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.camera.backproject(depth)[depth > 0]))
        part.colors = o3d.utility.Vector3dVector(frame.rgb[depth > 0] / 255.0)
        part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(*_NORMALS))
        part.orient_normals_towards_camera_location(np.zeros(3))
        part.transform(T)
        whole += part
    cloud = whole.voxel_down_sample(VOXEL)
    cloud.normalize_normals()
    cloud, _ = cloud.remove_radius_outlier(_MIN_NEIGHBOURS, 2 * VOXEL)
    points = np.asarray(cloud.points)
    votes = np.zeros(len(points))
    for frame, T in scan.tracked:
        rows, measured, z = measured_depths(points, usable_depth(frame), frame.camera, T)
        votes[rows[measured > z + _SEE_THROUGH]] -= 1
        votes[rows[np.abs(measured - z) <= _SEE_THROUGH]] += 1
    return cloud.select_by_index(np.flatnonzero(votes >= 0).tolist())
