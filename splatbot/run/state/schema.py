"""Schema of saved runs: stable names of the saved types and fields, independent of modules, classes and attributes.

A rename in the code changes the right side of this table only. A new attribute needs a row, or has to be listed as
transient. A changed meaning needs a higher :data:`FORMAT_VERSION` and a conversion for earlier versions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.gaussians import GaussianModel
from splatbot.mapping.depth_fusion import DepthNoiseModel
from splatbot.mapping.dynamic_objects import DynamicObjectFilter
from splatbot.mapping.extrinsics import ConstantPose, MeasuredPose
from splatbot.mapping.further_camera import FreeCamera, MountedCamera
from splatbot.mapping.joint_motion import JointMotionMonitor
from splatbot.mapping.keyframe_choice import FrameQuality
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.loop import LoopCloser
from splatbot.mapping.mapper import Mapper
from splatbot.mapping.observation import GraphLocation
from splatbot.mapping.posegraph import Edge, PoseGraph
from splatbot.mapping.refine import Refiner
from splatbot.optimize.adam import GaussianAdam
from splatbot.slam import FrameResult, Slam
from splatbot.tracking.budget import CostModel
from splatbot.tracking.features import Features
from splatbot.tracking.gyroscope import Gyroscope
from splatbot.tracking.motion_filter import CameraMotion, MotionFilter
from splatbot.tracking.motion_model import ConstantVelocity
from splatbot.tracking.reference import Reference, ReferencePoints
from splatbot.tracking.relocalization import PlaceSearch, RelocalizationCandidate
from splatbot.tracking.tracker import Tracker
from splatbot.tracking.uncertainty import Uncertainty

FORMAT_VERSION = 3
"""Version of the saved state. Version 1 names modules, classes and attributes of splatbot 0.1; 2 has one camera."""


@dataclass(frozen=True)
class SavedType:
    """A class whose objects a saved run holds.

    Args:
        cls: the class.
        fields: attribute by stable field name.
        transient: attributes that are not saved; ``create`` sets them.
        create: makes an object without saved fields. If None, the fields are all of its attributes.
        added: fields that earlier states of this format version lack. They keep the value of a new object.
        removed: fields of earlier states that objects no longer have.
    """

    cls: type
    fields: Mapping[str, str]
    transient: frozenset[str] = frozenset()
    create: Callable[[Config], object] | None = None
    added: frozenset[str] = frozenset()
    removed: frozenset[str] = frozenset()

    def defaults(self) -> dict[str, Any]:
        """Return the default value of each added field of a dataclass."""
        if not is_dataclass(self.cls):
            return {}
        return {f.name: f.default for f in fields(self.cls) if f.name in self.added}


def _dataclass(cls: type, *added: str) -> SavedType:
    """Describe a dataclass whose field names are stable."""
    return SavedType(cls, {field.name: field.name for field in fields(cls)}, added=frozenset(added))


def _fields(*attributes: str) -> dict[str, str]:
    """Return attributes by field name: an attribute without underscore, or ``field=attribute``."""
    pairs = (text.split("=") for text in attributes)
    return {pair[0].lstrip("_"): pair[-1] for pair in pairs}


class RemovedObject:
    """Represents an object of an earlier state that this version does not use."""


TYPES: Mapping[str, SavedType] = {
    "slam": SavedType(
        Slam,
        _fields(
            "config",
            "results",
            "_tracker",
            "_mapper",
            "_location",
            "_image_sizes",
            "_further_cameras",
            "_localization_only",
            "_joint_motion",
            "_quality",
        ),
        transient=frozenset({"_executor", "_first"}),
        create=Slam,
        added=frozenset({"quality", "further_cameras"}),
    ),
    "frame_result": _dataclass(FrameResult, "camera_name", "anchor"),
    "graph_location": _dataclass(GraphLocation),
    "joint_motion": SavedType(JointMotionMonitor, _fields("still_speed", "_last")),
    "camera": _dataclass(Camera, "fisheye"),
    "gaussians": _dataclass(GaussianModel),
    "keyframe": _dataclass(Keyframe, "is_poor", "camera_name"),
    "mapper": SavedType(
        Mapper,
        _fields(
            "config",
            "keyframes",
            "model",
            "pending_iterations",
            "version",
            "loops",
            "_refiner",
            "_dynamic_objects",
            "_depth_noise",
            "_unmapped_seen",
            "_anchors",
            "_robot_moving",
            "_frozen",
            "_stamp",
            "_observed_stamps",
        ),
        transient=frozenset({"_lock", "_submitted", "_latest", "_added", "_inserted"}),
        create=Mapper,
        added=frozenset({"anchors"}),
    ),
    "loop_closer": SavedType(
        LoopCloser,
        _fields(
            "config",
            "graph",
            "adjacency",
            "correction",
            "closed",
            "rejected",
            "inconsistency",
            "_ratios",
            "_unconfirmed",
        ),
        create=LoopCloser,
        added=frozenset({"inconsistency", "ratios"}),
    ),
    "pose_graph": _dataclass(PoseGraph),
    "edge": _dataclass(Edge, "covisible", "pair"),
    "refiner": SavedType(Refiner, _fields("config", "adam", "_random", "_latest_refined")),
    "adam": SavedType(GaussianAdam, _fields("rates", "steps", "skipped", "first", "second")),
    "dynamic_objects": SavedType(DynamicObjectFilter, _fields("timeout=timeout_s", "_cells", "_since", "_seen")),
    "depth_noise": _dataclass(DepthNoiseModel),
    "mounted_camera": SavedType(
        MountedCamera, _fields("pose", "carried", "anchor", "_retry_at", "_check_at", "_misses")
    ),
    "free_camera": SavedType(FreeCamera, _fields("tracker", "anchor", "_confirmed", "_retry_at")),
    "constant_pose": _dataclass(ConstantPose),
    "measured_pose": _dataclass(MeasuredPose),
    "tracker": SavedType(
        Tracker,
        _fields(
            "config",
            "motion",
            "_filter",
            "_gyroscope",
            "variance_scale",
            "_lost",
            "uncertainties=_keyframe_uncertainty",
            "_last_covariance",
            "_costs",
            "place_search=_search",
            "relocalization_candidate=_candidate",
        ),
        transient=frozenset({"_stages"}),
        create=lambda config: Tracker(config.tracking),
        added=frozenset({"filter", "gyroscope", "variance_scale"}),
        removed=frozenset({"velocity"}),
    ),
    "motion_model": SavedType(
        ConstantVelocity,
        _fields("_last", "_twist", "_interval", "_dead_reckoning"),
        create=lambda _: ConstantVelocity(),
    ),
    "motion_filter": SavedType(MotionFilter, _fields("_state"), create=lambda _: MotionFilter()),
    "camera_motion": _dataclass(CameraMotion),
    "gyroscope": SavedType(
        Gyroscope,
        _fields("bias", "bias_covariance", "_recent", "_record", "_trust"),
        create=lambda _: Gyroscope(),
    ),
    "camera_velocity": SavedType(RemovedObject, _fields("poses"), create=lambda _: RemovedObject()),
    "frame_quality": SavedType(FrameQuality, _fields("_recent"), create=lambda _: FrameQuality()),
    "stage_costs": SavedType(CostModel, _fields("_frame", "_runs"), create=lambda _: CostModel()),
    "place_search": SavedType(PlaceSearch, _fields("_next"), create=lambda _: PlaceSearch()),
    "relocalization_candidate": _dataclass(RelocalizationCandidate),
    "uncertainty": _dataclass(Uncertainty),
    "features": _dataclass(Features),
    "reference": _dataclass(Reference),
    "reference_points": _dataclass(ReferencePoints),
}
"""Saved types by stable name."""


@cache
def type_names() -> Mapping[type, str]:
    """Return the stable name of each saved class."""
    return {saved.cls: name for name, saved in TYPES.items()}


# Classes of version 1: stable name, module and class. A mapping worker has become its mapper.
_VERSION_1_CLASSES = """
slam                      splatbot.slam:Slam
frame_result              splatbot.slam:FrameResult
joint_motion              splatbot.mapping.motion:JointMotion
camera                    splatbot.camera:Camera
gaussians                 splatbot.gaussians.model:GaussianModel
keyframe                  splatbot.mapping.keyframes:Keyframe
mapper                    splatbot.mapping.mapper:Mapper
loop_closer               splatbot.mapping.loop:LoopCloser
pose_graph                splatbot.mapping.posegraph:PoseGraph
edge                      splatbot.mapping.posegraph:Edge
refiner                   splatbot.mapping.refine:Refiner
adam                      splatbot.optimize.adam:GaussianAdam
dynamic_objects           splatbot.mapping.moving:Movers
depth_noise               splatbot.mapping.evidence:DepthNoise
tracker                   splatbot.tracking.tracker:Tracker
motion_model              splatbot.tracking.predict:ConstantVelocity
stage_costs               splatbot.tracking.budget:Costs
gicp                      splatbot.tracking.wide:WideStage
place_search              splatbot.tracking.recover:KeyframeSearch
relocalization_candidate  splatbot.tracking.recover:Sighting
uncertainty               splatbot.tracking.uncertainty:Uncertainty
features                  splatbot.tracking.features:Features
reference                 splatbot.tracking.reference:Reference
reference_points          splatbot.tracking.reference:ReferencePoints
mapping_worker            splatbot.mapping.worker:MappingWorker
"""

# Attributes of version 1 whose field name is not the attribute without underscore: stable name, attribute, field.
_VERSION_1_FIELDS = """
slam                      _motion     joint_motion
slam                      _size       image_sizes
joint_motion              still       still_speed
keyframe                  still       static_mask
mapper                    owed        pending_iterations
mapper                    _movers     dynamic_objects
mapper                    _noise      depth_noise
mapper                    _revealed   unmapped_seen
mapper                    _held       robot_moving
loop_closer               _suspected  unconfirmed
refiner                   _latest     latest_refined
dynamic_objects           settle      timeout
tracker                   _known      uncertainties
tracker                   _wide       gicp
tracker                   _search     place_search
tracker                   _sighting   relocalization_candidate
motion_model              _reckoned   dead_reckoning
"""


def version_1_type(name: str) -> str:
    """Return the stable type name of a class name ``module:Class`` of version 1.

    Raises:
        ValueError: Version 1 has no such class.
    """
    known = {cls: stable for stable, cls in _rows(_VERSION_1_CLASSES)}
    if name not in known:
        raise ValueError(f"{name} is not a class of a saved run")
    return known[name]


def version_1_field(type_name: str, attribute: str) -> str:
    """Return the stable field name of an attribute of version 1."""
    renamed = {(stable, old): field for stable, old, field in _rows(_VERSION_1_FIELDS)}
    return renamed.get((type_name, attribute), attribute.lstrip("_"))


# Fields of version 2 that have another name: type, its field, field of this version.
_VERSION_2_FIELDS = """
slam    image_size      image_sizes
mapper  observed_stamp  observed_stamps
"""


def version_2_field(type_name: str, field: str) -> str:
    """Return the stable field name of a field of version 2."""
    renamed = {(stable, old): now for stable, old, now in _rows(_VERSION_2_FIELDS)}
    return renamed.get((type_name, field), field)


@cache
def _rows(table: str) -> Sequence[Sequence[str]]:
    return [line.split() for line in table.strip().splitlines()]


def upgrade_version_1(slam: Slam, unused: Mapping[str, Mapping[str, Any]]) -> None:
    """Complete a SLAM of version 1, whose state was distributed over other objects.

    Args:
        slam: decoded, without the fields that version 1 lacks.
        unused: saved fields of version 1 without a place in this version, by type.
    """
    mapper, outer = slam._mapper, unused.get("slam", {})
    mapper.loops.adjacency = mapper.loops.graph.adjacency()
    mapper.set_robot_moving(unused.get("mapping_worker", {}).get("held", mapper._robot_moving))
    if "looked" in outer:
        vars(mapper)["_observed_stamps"] = outer["looked"]
    slam._location = GraphLocation(unused.get("loop_closer", {}).get("anchor"))
    if not outer.get("growing", True):
        slam._localization_only = True
        mapper.freeze()


def upgrade_version_2(slam: Slam) -> None:
    """Convert the values of a SLAM of version 2 or 1, which has one camera, to those by name of the camera."""
    mapper, size, stamp = slam._mapper, vars(slam)["_image_sizes"], vars(slam._mapper)["_observed_stamps"]
    if not isinstance(size, dict):
        slam._image_sizes = {} if size is None else {"": size}
    if not isinstance(stamp, dict):
        mapper._observed_stamps = {"": stamp}
    if not isinstance(mapper._unmapped_seen, set):
        mapper._unmapped_seen = {""} if mapper._unmapped_seen else set()
