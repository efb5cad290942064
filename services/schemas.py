"""Bodies of requests and answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat
from splatbot.planning.timing import DEFAULT_SPEED
from splatbot.robots.joint_offsets import arm_name
from splatbot.services.arrays import Configurations, Points
from splatbot.workspace import MAX_JOINT_DELAY_S, MAX_PREFIX, Workspace

Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Mode = Literal["rgb", "depth", "normal", "alpha"]


MOST_MARGIN_M = 10.0  # larger than any arm
MAX_JOINTS = 64


class Request(BaseModel):
    model_config = ConfigDict(extra="forbid")

    one_of: ClassVar[tuple[str, ...]] = ()  # fields of which a request gives exactly one

    @model_validator(mode="after")
    def _given_one(self) -> Self:
        if self.one_of and sum(getattr(self, name) is not None for name in self.one_of) != 1:
            *others, last = self.one_of
            raise ValueError(f"give one of {', '.join(others)} and {last}")
        return self


BASE_EXAMPLE = {"translation": [0.0, 0.5, 0.0], "quaternion_wxyz": [0.7071068, 0.7071068, 0.0, 0.0]}
"""A robot's base in a map whose world is a level camera: z up, below it."""


class Pose(Request):
    """A rigid transform."""

    translation: Vector3 = Field((0.0, 0.0, 0.0), description="[m]")
    quaternion_wxyz: Vector4 = Field((1.0, 0.0, 0.0, 0.0), description="rotation")

    def matrix(self, field: str) -> NDArray[np.float64]:
        """Return the pose (4, 4).

        Raises:
            InputError: a number is not finite, or the quaternion is zero.
        """
        try:
            return pose_from_quat(self.translation, self.quaternion_wxyz)
        except ValueError as error:
            raise InputError(f"{error}.", field=field, hint="no rotation is quaternion_wxyz (1, 0, 0, 0)") from error


class HealthResponse(BaseModel):
    """Liveness or readiness of the process."""

    status: Literal["ok", "ready"] = Field(description="ok: alive; ready: answers requests")
    version: str = Field(description="of splatbot")
    unsaved: int = Field(0, description="maps whose last save failed; they are served from memory")


class Bounds(BaseModel):
    """Axis-aligned box around the Gaussians' centres, world frame [m]."""

    low: Vector3 = Field(description="smallest x, y, z [m]")
    high: Vector3 = Field(description="largest x, y, z [m]")


class MapInfo(BaseModel):
    """A map as it is now."""

    id: str = Field(description="name in URLs")
    map_version: int = Field(description="grows with every published state; 0: nothing yet")
    state: Literal["static", "mapping", "ended", "failed"] = Field(description="static: from a file")
    detail: str | None = Field(None, description="why mapping failed, or waits for its camera")
    source: str = Field(description="file, log or camera of the map")
    gaussians: int = Field(description="number of Gaussians")
    bytes: int = Field(description="memory of the Gaussians")
    sh_degree: int = Field(description="degree of the spherical harmonics of colours, 0..4")
    stamp: float = Field(description="time of the last frame in the map [s]")
    bounds: Bounds | None = Field(None, description="null while the map is empty")
    robot: RobotMaskInfo | None = Field(None, description="robot that is masked in the frames; null: none")
    cameras: dict[str, FurtherCameraInfo] = Field(
        {}, description="further cameras by name, while the process maps; their frames are in no other field"
    )


class MapList(BaseModel):
    """All maps."""

    maps: list[MapInfo] = Field(description="all maps")


class RobotInView(Request):
    """The robot in the camera's view. Its pixels are masked; a frame without its joints or TF is not mapped."""

    name: str = Field(description="robot, as `splatbot robot list` names it")
    T_link_camera: Pose | None = Field(
        None,
        description="pose of the camera on its link; values left out are those of the recording's scene.yaml. In the "
        "map `ros`, and in recordings of ROS topics, it may be left out if TF has it",
    )
    camera_link: int = Field(-1, description="index of the link that carries the camera; -1: the last, 0: the base")
    joint_offsets: list[float] | None = Field(
        None,
        max_length=MAX_JOINTS,
        description="added to measured joint positions [rad or m]; null: none; left out: those of the recording",
    )
    joint_delay: float = Field(
        0.0,
        ge=-MAX_JOINT_DELAY_S,
        le=MAX_JOINT_DELAY_S,
        description="time by which the stamps of joint states are later than the motion [s]",
    )
    joint_names: list[str] = Field(
        [], max_length=MAX_JOINTS, description="names of the joints in joint states; default: those of the model"
    )
    tf_prefix: str = Field(
        "", max_length=MAX_PREFIX, description="prefix of the names of the robot's links in TF, as left_"
    )

    def workspace(self, known: Workspace | None) -> Workspace:
        """Return the workspace with the given values; the others are those of the known one.

        Raises:
            InputError: a value is invalid.
        """
        known = self.with_offsets(known)
        own = self.model_fields_set - {"name", "joint_offsets"}
        given: dict[str, Any] = {name: getattr(self, name) for name in own}
        if self.T_link_camera is not None:
            given["T_link_camera"] = self.T_link_camera.matrix("T_link_camera")
        given["joint_names"] = tuple(given.get("joint_names", known.joint_names))
        return replace(known, **given)

    def with_offsets(self, known: Workspace | None) -> Workspace:
        """Return a scene with the given joint offsets; if they are left out, with those of the known scene.

        Raises:
            InputError: an offset is not finite.
        """
        scene = known or Workspace()
        if "joint_offsets" not in self.model_fields_set:
            return scene
        if self.joint_offsets is None:
            return replace(scene, joint_offsets=None, offsets_of="")
        return replace(scene, joint_offsets=np.array(self.joint_offsets), offsets_of=arm_name(self.name))


class RobotMaskInfo(BaseModel):
    """How the robot was masked in the frames so far."""

    name: str = Field(description="robot")
    masked: int = Field(description="frames whose pixels of the robot are masked")
    refused: int = Field(description="frames that are not mapped, because joint states, or TF, were missing or stale")
    problem: str | None = Field(None, description="why the latest frame was refused; null if it was masked")


class CameraOnRobot(Request):
    """Mount of a further camera on the map's robot, whose pixels are masked in its frames."""

    T_link_camera: Pose = Field(description="pose of the camera on its link")
    camera_link: int = Field(-1, description="index of the link that carries it; -1: the last, 0: the base")

    def workspace(self, first: Workspace) -> Workspace:
        """Return the workspace of the camera; the joints are those of the workspace of the first camera.

        Raises:
            InputError: a value is invalid.
        """
        return replace(first, T_link_camera=self.T_link_camera.matrix("T_link_camera"), camera_link=self.camera_link)


Finite = Annotated[float, Field(allow_inf_nan=False)]


class FurtherCameraIn(Request):
    """A camera of the map other than the first one: fixed, carried, or with neither pose free.

    The pose is exact if both standard deviations are 0. Otherwise it is the start of an estimate against the map.
    """

    T_world_camera: Pose | None = Field(
        None, description="pose of a fixed camera; the world is the first camera in its first frame"
    )
    T_first_camera: Pose | None = Field(None, description="pose on the first camera, which carries it")
    translation_sigma: float = Field(
        0.0, description="standard deviation of the translation along each axis, at most 0.2 [m]"
    )
    rotation_sigma: float = Field(
        0.0, description="standard deviation of the rotation about each axis, at most 0.35 [rad]"
    )
    sensor: dict[str, Finite | list[Finite]] = Field(
        {}, max_length=64, description="values of the section `sensor` of the configuration"
    )
    robot: CameraOnRobot | None = Field(
        None, description="its mount on the map's robot; without it, frames are refused in a map with a robot"
    )

    def settings(self) -> dict[str, Any]:
        """Return the values of :class:`splatbot.config.CameraConfig`."""
        return self.model_dump(exclude={"robot"}, exclude_none=True)


MAX_FURTHER_CAMERAS = 7
CameraName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,32}$")]


class MountPose(BaseModel):
    """Estimated or given pose of a fixed camera (T_world_camera), or of a carried one (T_first_camera)."""

    translation: Vector3 = Field(description="[m]")
    quaternion_wxyz: Vector4 = Field(description="rotation")
    translation_sigma: float = Field(description="largest standard deviation along an axis; 0: given as exact [m]")
    rotation_sigma: float = Field(description="largest standard deviation about an axis; 0: given as exact [rad]")


class FurtherCameraInfo(BaseModel):
    """A further camera of a map as it is now."""

    kind: Literal["fixed", "carried", "free"] = Field(description="its relation to world and first camera")
    frames: int = Field(description="frames that were read; refused ones do not count")
    tracked: int = Field(description="frames with a pose")
    lost: int = Field(description="frames without a pose, which are not mapped")
    keyframes: int = Field(description="frames that entered the map")
    reason: str | None = Field(description="why the newest frame has no pose; null if it has one")
    pose: MountPose | None = Field(description="null while it is not known, and for a free camera")


class MapRequest(Request):
    """A map to be made: of a recording, or, without ``log``, of frames that will be pushed."""

    id: str = Field(description="its name in URLs: a-z, 0-9, - and _")
    log: str | None = Field(
        None,
        description="synthetic:SCENE?..., or a folder, .mcap, .bag or rig of several cameras (.yaml) under one of the "
        "service's log roots",
    )
    camera: str | None = Field(None, description="preset of intrinsics (tum_fr1, ...) instead of the log's own")
    max_frames: Annotated[int, Field(ge=1)] | None = Field(None, description="read no more than these")
    robot_base: Pose | None = Field(None, description="T_world_base, for questions about the arm")
    robot: RobotInView | None = Field(None, description="robot in view, which is masked; null: no robot is masked")
    cameras: dict[CameraName, FurtherCameraIn] | None = Field(
        None,
        max_length=MAX_FURTHER_CAMERAS,
        description="further cameras of pushed frames by name; null: those of the service's configuration",
    )


class DistanceRequest(Request):
    """Points to query."""

    points: Points = Field(description="(P, 3), world frame [m]")
    n_sigma: Annotated[float, Field(gt=0, allow_inf_nan=False)] = Field(
        2.0, description="standard deviations at which a Gaussian's surface is taken to be"
    )


class CameraIn(Request):
    """Pinhole intrinsics [px]; integer coordinates are pixel centres, as in OpenCV."""

    fx: float = Field(description="focal length along x [px]")
    fy: float = Field(description="focal length along y [px]")
    cx: float = Field(description="principal point, column [px]")
    cy: float = Field(description="principal point, row [px]")
    width: int = Field(description="columns of the image [px]")
    height: int = Field(description="rows of the image [px]")


class RenderRequest(Request):
    """A view to be drawn. The pose is a matrix, or a translation and a quaternion, or left out for the default view."""

    mode: Mode = Field("rgb", description="quantity that the image shows")
    camera: CameraIn | None = Field(None, description="default: 640x480 pixels, 60 degrees wide")
    T_world_camera: tuple[Vector4, Vector4, Vector4, Vector4] | None = Field(None, description="(4, 4), row by row")
    translation: Vector3 | None = Field(None, description="camera centre, world frame [m]")
    quaternion_wxyz: Vector4 | None = Field(None, description="rotation of T_world_camera")
    depth_range_m: tuple[float, float] | None = Field(None, description="colours of mode depth; default: 2..98 %")

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        if (self.translation is None) != (self.quaternion_wxyz is None):
            raise ValueError("give translation and quaternion_wxyz together")
        if self.T_world_camera is not None and self.translation is not None:
            raise ValueError("give either T_world_camera or translation and quaternion_wxyz")
        return self


class ViewIn(Request):
    """One camera of a batch."""

    camera: CameraIn = Field(description="pinhole intrinsics")
    pose: Pose = Field(description="T_world_camera")


class ViewsRequest(Request):
    """Several views at once, as a policy with several cameras needs them."""

    views: list[ViewIn] = Field(min_length=1, description="cameras and their poses")
    modes: list[Mode] = Field(["rgb"], min_length=1, max_length=4, description="quantities of each view")


class CollisionsRequest(Request):
    """Configurations of an arm to check."""

    q: Configurations = Field(description="(C, J) joint values [rad or m]")
    robot: str = Field("panda", description="as `splatbot robot list` names it")
    base: Pose | None = Field(None, description="T_world_base; by default that of the map")
    margin: Annotated[float, Field(ge=0, le=MOST_MARGIN_M)] = Field(0.0, description="room to keep [m]")
    opening: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = Field(None, description="of the gripper [m]")
    gradient: bool = Field(False, description="also the clearance's gradient over the joints")


class IkRequest(Request):
    """A pose of the tool to be reached."""

    pose: Pose = Field(description="T_base_tcp, or T_world_tcp with `map`")
    robot: str = Field("panda", description="robot, as `splatbot robot list` names it")
    near: list[float] | None = Field(None, description="posture to stay near [rad or m]; default: home")
    seeds: Annotated[int, Field(ge=1, le=256)] = Field(32, description="random starts of the search")
    map: str | None = Field(None, description="keep only solutions that are free in this map")
    base: Pose | None = Field(None, description="T_world_base; by default that of the map")
    margin: Annotated[float, Field(ge=0, le=MOST_MARGIN_M)] = Field(0.0, description="room to keep to the map [m]")


class PlanRequest(Request):
    """A motion to be planned; the goal is joints or a pose of the tool."""

    one_of = ("goal", "goal_pose")

    start: list[float] | None = Field(None, description="(J,) [rad or m]; default: the robot's home")
    goal: list[float] | None = Field(None, description="(J,) [rad or m]")
    goal_pose: Pose | None = Field(None, description="T_base_tcp")
    robot: str = Field("panda", description="robot, as `splatbot robot list` names it")
    base: Pose | None = Field(None, description="T_world_base; by default that of the map")
    margin: Annotated[float, Field(ge=0, le=MOST_MARGIN_M, strict=True)] | Literal["auto"] | None = Field(
        None,
        description='clearance to the map [m], or "auto": the audited error of the map where the arm moves. The '
        'default is "auto" where the map has a recording, else 0',
    )
    confidence: Annotated[float, Field(ge=0, le=1)] = Field(
        0.999, description='share of the confirmed surface that the margin "auto" covers'
    )
    unknown: Literal["free", "cautious", "occupied"] = Field(
        "free",
        description='space that no frame observed: "occupied" is all of it, "cautious" where two frames looked and '
        "measured no depth. Needs a recording, the base of the map, and seconds for the first plan of a robot",
    )
    support: bool = Field(
        True, description="the support plane of the map's scene.yaml is an obstacle, also where no frame saw it"
    )
    budget_ms: Annotated[float, Field(gt=0, allow_inf_nan=False)] = Field(100.0, description="time to plan")
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(0, description="seed of the search")
    speed: Annotated[float, Field(gt=0, le=1)] = Field(
        DEFAULT_SPEED,
        description="fraction of the joints' limits of velocity and acceleration; 1 is as fast as the arm can",
    )
    rate: Annotated[float, Field(ge=1, le=1000)] | None = Field(
        None, description="of the trajectory's points [Hz]; by default its knots, which give the same curve again"
    )


class PictureHint(Request):
    """A place in a picture: a pixel, or the corners of a rectangle."""

    one_of = ("pixel", "box")

    camera: CameraIn = Field(description="pinhole intrinsics of the picture")
    pose: Pose = Field(description="T_world_camera")
    pixel: tuple[float, float] | None = Field(None, description="(u, v) [px]")
    box: Vector4 | None = Field(None, description="(u0, v0, u1, v1) [px]")


class GraspsRequest(Request):
    """An object to grasp: by name, by a point in the world, or by a pixel of an image."""

    one_of = ("target", "point", "picture")

    target: str | None = Field(None, max_length=200, description='words, as "largest box" or "red cup"')
    point: Vector3 | None = Field(None, description="on or in the object, world frame [m]")
    picture: PictureHint | None = Field(None, description="place of the object in an image")
    robot: str = Field("panda", description="robot, as `splatbot robot list` names it")
    base: Pose | None = Field(None, description="T_world_base, z up; by default that of the map")
    hand_only: bool = Field(False, description="leave the arm out")
    approach: Literal["any", "top", "side"] = Field("any", description="direction of the approach")
    min_confidence: Annotated[float, Field(ge=0, le=1)] = Field(
        0.5, description="least probability of success of a grasp, as simulated trials calibrate it"
    )
    accept_implied: bool = Field(
        False, description="offer grasps of which no contact is at measured depth, or whose finger enters unseen space"
    )
    friction: Annotated[float, Field(gt=0, le=2)] = Field(0.5, description="coefficient between pads and object")
    samples: Annotated[int, Field(ge=10, le=5000)] = Field(
        400, description="places tried, four times as many with sharper rims where that finds nothing: the knob of time"
    )
    wanted: Annotated[int, Field(ge=1, le=100)] = Field(10, description="largest number of grasps")
    margin: Annotated[float, Field(ge=0, le=MOST_MARGIN_M, strict=True)] | Literal["auto"] | None = Field(
        None,
        description='clearance of hand and arm to the rest [m], or "auto": the audited error of the map around the '
        'target, for the arm alone. The default is "auto" where the map has a recording, else 0',
    )
    unknown: Literal["free", "cautious", "occupied"] = Field(
        "free",
        description="space that no frame observed, as in a plan. Arm and hand avoid it at the pre-grasp, and the arm "
        "on the approach",
    )
    min_observations: Annotated[int, Field(ge=1, le=1000)] = Field(
        1, description="least number of keyframes of a Gaussian"
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = Field(0, description="seed of the search")


class PicksRequest(Request):
    """An object to pick in the twin."""

    scene: str = Field("tabletop_clutter", description="a shipped scene")
    target: str = Field(max_length=200, description='a name of the scene, or words as "largest box"')
    views: Annotated[int, Field(ge=2, le=24)] = Field(8, description="of the scan")
    lift: Annotated[float, Field(gt=0.03, le=1)] = Field(0.15, description="how far up [m]")
    force: Annotated[float, Field(gt=0, le=1000)] | None = Field(None, description="of the fingers [N]")
    tries: Annotated[int, Field(ge=1, le=20)] = Field(5, description="grasps whose way is looked for")
    budget_ms: Annotated[float, Field(gt=0)] = Field(200.0, description="for the way to each: the knob of time [ms]")
    margin: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="room to keep from the rest [m]")
    home: bool = Field(False, description="carry it to where the arm began")
    look: bool = Field(
        True, description="look again from the wrist before the fingers close, and whether the place is empty after"
    )
    attempts: Annotated[int, Field(ge=1, le=10)] = Field(
        3, description="grasps that are executed; more than 1 needs look"
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="of sensor noise and search")


class TrajectoryRequest(Request):
    """A planned motion to be followed."""

    plan: str = Field(max_length=64, description="id of a plan")
    arm: str = Field("fake", max_length=80, description="which arm, as GET /v1/arms lists them")
    lease: str = Field(max_length=64, description="lease of the arm, from POST /v1/arms/ARM/lease")


class LeaseRequest(Request):
    """The lease of an arm."""

    seconds: Annotated[float, Field(ge=0.5, le=60)] = Field(
        10.0, description="the arm stops if the lease is not renewed within this time [s]"
    )
    preempt: bool = Field(
        False, description="take it from another owner: while the arm rests; during a motion only with the scope admin"
    )


class LeaseInfo(BaseModel):
    """A lease of an arm."""

    lease: str = Field(description="motions name it; keep it secret")
    arm: str = Field(description="name of the arm")
    seconds: float = Field(description="renew it within this time: PUT /v1/leases/LEASE [s]")


class StopInfo(BaseModel):
    """State of the emergency stop."""

    stopped: bool = Field(description="whether all arms are stopped")
    by: str | None = Field(None, description="client that stopped them")
    since: float | None = Field(None, description="Unix time [s]")


class TrialsRequest(Request):
    """Trials in the twin."""

    scene: str | None = Field(None, description="a shipped scene; default: empty")
    map: str | None = Field(None, description="instead: a map of this service, as the shapes that physics takes it for")
    base: Pose | None = Field(None, description="T_world_base in the map; default: the map's own")
    plan: str | None = Field(None, description="id of a plan to follow; default: the scene's own moves")
    trials: Annotated[int, Field(ge=1, le=100)] = Field(1, description="number of trials")
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="of the first trial; 0 displaces nothing")
    force: list[str] = Field([], max_length=32, description="effects enabled in any case")
    forbid: list[str] = Field([], max_length=32, description="effects that are disabled")


class JobInfo(BaseModel):
    """A job as it stands."""

    id: str = Field(description="name in URLs")
    kind: str = Field(description="map, merge, diff, pick or trials")
    state: Literal["queued", "running", "succeeded", "failed", "cancelled"] = Field(description="state of the job")
    progress: float = Field(description="0..1")
    detail: str | None = Field(description="current step, or the error")
    result: dict[str, Any] | None = Field(description="result of a job that succeeded")
    created: float = Field(description="Unix time [s]")
    started: float | None = Field(description="Unix time [s]; null while it waits")
    ended: float | None = Field(description="Unix time [s]; null until it ends")


class JobList(BaseModel):
    """All jobs, the oldest first."""

    jobs: list[JobInfo] = Field(description="all jobs")
