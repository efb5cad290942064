"""Two other stacks on the same frames and poses: a mesh of fused depth, and a point cloud in an octree."""

from __future__ import annotations

import time
from dataclasses import dataclass
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
from splatbot.sim.trials.scan import CONSTANTS as SCAN
from splatbot.sim.trials.scan import TrialScan, usable_depth
from splatbot.sim.trials.solid import SolidPickPlanner, SolidReach, SolidWorld
from splatbot.sim.trials.stacks import OPTIONS, StackMap


@dataclass(frozen=True)
class TrialPeerConstants:
    """Constants of the map representations that are compared.

    Args:
        voxel: [m] voxel size of the distance field and of the cloud.
        leaf: [m] leaf size of the octree.
        observer_distance: [m] distance along the normal from a surface to its assumed observer.
        grey: grey level of the mesh, whose colours are not used.
        see_through: [m] measured depth behind a point that contradicts it.
        normals: [m] radius, and number of neighbours, of a normal estimate.
        min_neighbours: points with fewer are outliers.
    """

    voxel: float = 0.004
    leaf: float = 0.01
    observer_distance: float = 0.5
    grey: float = 0.6
    see_through: float = 0.03
    normals: tuple[float, int] = (0.012, 24)
    min_neighbours: int = 3


CONSTANTS = TrialPeerConstants()


_NODE, _LEAF_NODE = 256, 16  # [bytes] of FCL's BVNode<OBBRSS>, as measured, and of OctoMap's OcTreeNode
_SINGLE = 2  # ratio of float64 to float32, in which coordinates could be stored


class MeshStack:
    """TSDF fusion, marching cubes, and python-fcl on the triangles."""

    name = "mesh"
    looks = False

    def learn(self, scan: TrialScan) -> StackMap:
        """Implement :meth:`splatbot.sim.trials.stacks.Stack.learn`."""
        begin = time.perf_counter()
        fusion = DepthFusion(CONSTANTS.voxel, SCAN.max_depth)
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
        return _stack_map(scan, vertices, normals, np.full_like(vertices, CONSTANTS.grey), world, size, begin)


class CloudStack:
    """Points with normals, and python-fcl on an octree of them."""

    name = "cloud"
    looks = False

    def learn(self, scan: TrialScan) -> StackMap:
        """Implement :meth:`splatbot.sim.trials.stacks.Stack.learn`."""
        begin = time.perf_counter()
        cloud = _cloud(scan)
        points, normals, colors = (np.asarray(x) for x in (cloud.points, cloud.normals, cloud.colors))

        def around(rows: NDArray[np.int64]) -> Any:
            return fcl_octree(np.delete(points, rows, axis=0), CONSTANTS.leaf)

        world = SolidWorld(points, fcl_octree(points, CONSTANTS.leaf), around)
        voxels = len(np.unique(np.floor(points / CONSTANTS.leaf).astype(np.int64), axis=0))
        nodes = voxels + len(octomap_bytes(points, CONSTANTS.leaf)) // 2  # each inner node takes two bytes
        size = (points.nbytes + normals.nbytes) // _SINGLE + nodes * _LEAF_NODE
        return _stack_map(scan, points, normals, colors, world, size, begin)


def _stack_map(
    scan: TrialScan, points: Array, normals: Array, colors: Array, world: SolidWorld, size: int, begin: float
) -> StackMap:
    """Convert the surface to discs for segmentation and grasps, with the solid world for the arm."""
    scene = segment(discs(points, normals, colors, CONSTANTS.voxel), scan.T_world_base, cut=False)
    robot = panda()

    def planners(target: Target) -> tuple[GraspSampler, PickPlanner]:
        reach = SolidReach(robot, scene.T_world_base, world, target.rows)
        observers = points + CONSTANTS.observer_distance * normals
        sampler = GraspSampler(
            scene, robot, observers=observers, views=scan.views, make_reach=lambda around, around_held, whole: reach
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
        part.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(*CONSTANTS.normals))
        part.orient_normals_towards_camera_location(np.zeros(3))
        part.transform(T)
        whole += part
    cloud = whole.voxel_down_sample(CONSTANTS.voxel)
    cloud.normalize_normals()
    cloud, _ = cloud.remove_radius_outlier(CONSTANTS.min_neighbours, 2 * CONSTANTS.voxel)
    points = np.asarray(cloud.points)
    votes = np.zeros(len(points))
    for frame, T in scan.tracked:
        rows, measured, z = measured_depths(points, usable_depth(frame), frame.camera, T)
        votes[rows[measured > z + CONSTANTS.see_through]] -= 1
        votes[rows[np.abs(measured - z) <= CONSTANTS.see_through]] += 1
    return cloud.select_by_index(np.flatnonzero(votes >= 0).tolist())
