"""Sections of the configuration, with the default and the meaning of every setting."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, field_serializer, model_validator
from pydantic_core.core_schema import FieldSerializationInfo


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")

    PUBLIC: ClassVar[frozenset[str]] = frozenset()
    """Keys that files name under the section itself; all others stand under ``expert:``."""


class SensorConfig(_Section):
    """Noise model and range of the RGB-D sensor, shared by tracking, mapping and the collision margin.

    The σ of a depth z [m] is ``sigma_depth_floor + sigma_depth_quad z²`` (Khoshelham and Elberink 2012).
    """

    PUBLIC: ClassVar[frozenset[str]] = frozenset(
        {
            "min_depth",
            "max_depth",
            "sigma_gray",
            "sigma_depth_floor",
            "sigma_depth_quad",
            "readout",
        }
    )

    min_depth: float = Field(default=0.2, gt=0, description="smaller depth is ignored, such as that of a gripper [m]")
    max_depth: float = Field(default=6.0, gt=0, description="larger depth is ignored [m]")
    sigma_gray: float = Field(default=0.02, gt=0, description="standard deviation of a grey value in 0..1")
    sigma_depth_floor: float = Field(default=1e-3, gt=0, description="constant part of the depth's σ [m]")
    sigma_depth_quad: float = Field(default=2e-3, ge=0, description="part of the depth's σ that grows with z² [1/m]")
    readout: float = Field(
        default=0.0,
        ge=0,
        le=0.2,
        description="rolling shutter: time from the first row of an image to the last, whose middle is the stamp; 0 is "
        "a global shutter [s]",
    )
    depth_delay: float = Field(
        default=0.0, ge=-0.2, le=0.2, description="time by which the depth image is later than the colour image [s]"
    )
    depth_to_color: tuple[float, float, float, float, float, float] = Field(
        default=(0.0,) * 6,
        description="T_color_depth if depth is not registered to colour: translation [m] and rotation vector [rad]",
    )
    depth_scale: float = Field(default=1.0, gt=0, description="factor on the measured depth")
    depth_bias: float = Field(default=0.0, description="added to the measured depth, after the factor [m]")
    exposure: float = Field(default=0.0, ge=0, le=0.2, description="exposure time of colour: motion blur [s]")
    stamp_sigma: float = Field(
        default=5e-3, ge=0, le=0.2, description="standard deviation of the stamps: latency and jitter [s]"
    )
    image_sigma: float = Field(
        default=0.25,
        ge=0,
        le=20,
        description="standard deviation of image points by the models of lens and shutter and the registration of "
        "depth [px]",
    )
    calibration_error: float = Field(
        default=3e-3,
        ge=0,
        le=0.2,
        description="relative error of the focal length and of depth, which accumulates along a path",
    )
    depth_sigma_scale: float = Field(
        default=10.0,
        ge=1,
        description="factor on the depth's σ in the direct alignment: filters, calibration and late depth images "
        "cause errors that all pixels share",
    )
    max_depth_difference: float = Field(
        default=0.05, gt=0, description="pixels whose depths differ by more belong to different surfaces [m]"
    )


# Settings that a tracking budget decides: the row of the largest limit [ms] that does not exceed the budget.
_EFFORT: dict[float, dict[str, Any]] = {
    0: {"n_pixels": 2400, "iterations": 4, "features": "always", "n_features": 500},
    100: {"n_pixels": 4800, "iterations": 8, "features": "always", "n_features": 2000},
    300: {"n_pixels": 9600, "iterations": 10, "features": "always", "n_features": 2000},
    1000: {"n_pixels": 19200, "iterations": 12, "features": "always", "n_features": 2000},
}


class TrackingConfig(_Section):
    """Camera tracking.

    ``budget_ms`` decides ``n_pixels``, ``iterations``, ``features`` and ``n_features`` unless they are given. In YAML,
    null means that the budget decides. :class:`Config` sets ``sensor`` to its own section.
    """

    PUBLIC: ClassVar[frozenset[str]] = frozenset({"budget_ms", "deterministic"})

    sensor: SensorConfig = Field(default_factory=SensorConfig, exclude=True, repr=False)
    budget_ms: float = Field(
        default=100.0, gt=0, description="time for one frame without decoding it: accuracy for time [ms]"
    )
    deterministic: bool = Field(
        default=True, description="count work instead of milliseconds, so that a log gives the same map bit for bit"
    )
    max_width: int = Field(default=640, ge=64, description="width of the finest pyramid level [px]")
    n_levels: int = Field(default=3, ge=1, le=6, description="levels of the image pyramid")
    n_pixels: int = Field(default=4800, ge=100, description="pixels per level in the alignment: accuracy for time")
    iterations: int = Field(default=8, ge=1, description="Gauss-Newton iterations per level: accuracy for time")
    reference_keyframes: int = Field(default=2, ge=1, description="keyframes that a frame is aligned to at once")
    dense_weight: float = Field(
        default=0.03,
        gt=0,
        le=1,
        description="weight of a dense residual relative to a feature's: neighbouring pixels have correlated errors",
    )
    dense_share: float = Field(
        default=1.0,
        ge=0,
        le=1,
        description="share of the dense residuals' spread over image cells in the weights of dense residuals and "
        "features; 0 uses dense_weight alone",
    )
    features: Literal["always", "needed"] = Field(
        default="always", description="match ORB features in every frame, or only if motion or residuals are large"
    )
    n_features: int = Field(default=2000, ge=100, description="ORB keypoints per frame: accuracy for time")
    match_keyframes: int = Field(default=3, ge=1, description="number of nearest keyframes whose features are matched")
    match_radius: float = Field(
        default=0.06, gt=0, le=1, description="search radius around the predicted place of a feature [image width]"
    )
    min_local_matches: int = Field(
        default=60,
        ge=20,
        description="with fewer matches in the search radius, features are matched in the whole image",
    )
    features_motion: float = Field(
        default=0.03, ge=0, description="predicted motion from which features are needed [m]"
    )
    features_rotation: float = Field(
        default=0.05, ge=0, description="predicted rotation from which features are needed [rad]"
    )
    gicp: Literal["needed", "never"] = Field(
        default="needed", description="register point clouds by G-ICP if motion is large and features fail"
    )
    gicp_points: int = Field(default=4000, ge=100, description="points of a registered cloud: accuracy for time")
    min_depth_coverage: float = Field(
        default=0.02, ge=0, le=1, description="least share of pixels with depth in a first frame or a keyframe"
    )
    min_overlap: float = Field(default=0.15, ge=0, le=1, description="least share of the reference in view, else lost")
    min_inliers: float = Field(default=0.3, ge=0, le=1, description="least share of residuals within 3 σ, else lost")
    min_eigen_ratio: float = Field(
        default=0.02,
        ge=0,
        le=1,
        description="least eigenvalue ratio of the translation's information; below it the motion prior fills in and "
        "the frame is degraded",
    )

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        return {key: value for key, value in values.items() if value is not None or key not in _EFFORT[0]}

    @model_validator(mode="after")
    def _by_budget(self) -> TrackingConfig:
        row = _EFFORT[max(limit for limit in _EFFORT if limit <= self.budget_ms)]
        for key in row.keys() - self.model_fields_set:
            self.__dict__[key] = row[key]
        return self

    @field_serializer(*_EFFORT[0], when_used="json")
    def _null_if_by_budget(self, value: Any, info: FieldSerializationInfo) -> Any:
        return value if info.field_name in self.model_fields_set else None


class MappingConfig(_Section):
    """Fusion of keyframes into Gaussians, and their refinement."""

    PUBLIC: ClassVar[frozenset[str]] = frozenset(
        {
            "max_gaussians",
            "max_width",
            "stride",
            "keyframe_translation",
            "keyframe_rotation",
            "max_keyframes",
            "refine_iterations",
            "final_iterations",
            "threaded",
            "holdout_every",
        }
    )

    max_gaussians: int = Field(default=150_000, ge=100, description="hard cap on the map's size: accuracy for time")
    max_width: int = Field(default=640, ge=64, description="width of the images that are fused [px]")
    stride: int = Field(default=3, ge=1, description="one new Gaussian per stride x stride pixels: accuracy for time")
    footprint: float = Field(default=1.0, gt=0, description="size of a new Gaussian over the grid's half spacing")
    thickness: float = Field(default=0.2, gt=0, le=1, description="largest thickness of a Gaussian over its size")
    initial_opacity: float = Field(default=0.8, gt=0, lt=1, description="opacity of a new Gaussian")
    unexplained_alpha: float = Field(
        default=0.6, ge=0, le=1, description="pixels whose rendered alpha is lower get new Gaussians"
    )
    surface_depth_tolerance: float = Field(
        default=0.04, gt=0, description="depths that differ by a larger share belong to different surfaces"
    )
    reference_alpha: float = Field(
        default=0.9, ge=0, le=1, description="alpha from which a keyframe's reference takes the rendered depth"
    )
    keyframe_translation: float = Field(
        default=0.04, gt=0, description="distance to every keyframe from which a frame is a new keyframe [m]"
    )
    keyframe_rotation: float = Field(
        default=0.07, gt=0, description="rotation to every keyframe from which a frame is a new keyframe [rad]"
    )
    replace_poor: bool = Field(
        default=False, description="a blurred or degraded keyframe is replaced by a better view of the same place"
    )
    max_keyframes: int = Field(
        default=300, ge=10, description="hard cap on keyframes, 3 MB each; the most redundant are dropped: memory"
    )
    refine_iterations: int = Field(default=15, ge=0, description="optimiser iterations per keyframe: accuracy for time")
    final_iterations: int = Field(default=300, ge=0, description="optimiser iterations after the last frame")
    densify_gradient: float = Field(
        default=3e-4,
        ge=0,
        description="mean view-space gradient from which a Gaussian is split after the last frame, for images of "
        "width 2: accuracy for memory and time",
    )
    window: int = Field(default=8, ge=1, description="number of latest keyframes that refinement prefers")
    depth_weight: float = Field(default=4.0, ge=0, description="weight of the relative depth loss against colour")
    dssim_weight: float = Field(
        default=0.0, ge=0, le=1, description="share of 1 - SSIM in the colour loss; 0 uses L1 alone, which is cheaper"
    )
    means_lr: float = Field(default=5e-4, ge=0, description="learning rate of positions [m]")
    normal_step_scale: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="factor on a position's step along its normal: depth measures that direction better than images do",
    )
    quats_lr: float = Field(default=1e-3, ge=0, description="learning rate of orientations")
    scales_lr: float = Field(default=5e-2, ge=0, description="learning rate of log-scales")
    opacities_lr: float = Field(default=2e-2, ge=0, description="learning rate of opacity logits")
    sh_lr: float = Field(default=2e-2, ge=0, description="learning rate of colour coefficients")
    min_opacity: float = Field(default=0.05, ge=0, le=1, description="Gaussians of lower opacity are pruned")
    max_pixels: float = Field(
        default=6.0, gt=0, description="largest standard deviation in refinement [px of the keyframe]"
    )
    max_scale: float = Field(default=0.5, gt=0, description="larger Gaussians are pruned [m]")
    observe_interval_s: float = Field(
        default=0.2, ge=0, description="time between frames that update visibility between keyframes [s]"
    )
    dynamic_timeout_s: float = Field(
        default=1.0, ge=0, description="a new object that has not moved for this time enters the map [s]"
    )
    threaded: bool = Field(
        default=False, description="map in a thread next to tracking: shorter frames, but runs do not repeat exactly"
    )
    still_joint_speed: float = Field(
        default=0.05, ge=0, description="refinement pauses while a reported joint moves faster [rad/s]"
    )
    holdout_every: int = Field(
        default=8, ge=0, description="every n-th frame is tracked and scored, but not mapped; 0 holds out no frame"
    )


class LoopsConfig(_Section):
    """Loop closure."""

    PUBLIC: ClassVar[frozenset[str]] = frozenset({"enabled"})

    enabled: bool = Field(default=True, description="detect loops and correct the map for drift")
    min_votes: int = Field(default=25, ge=1, description="matches among 400 descriptors that make a loop candidate")
    min_matches: int = Field(default=30, ge=20, description="least number of features that agree with one pose")
    min_overlap: float = Field(default=0.3, ge=0, le=1, description="least share of a keyframe that is in view")
    min_inliers: float = Field(default=0.5, ge=0, le=1, description="least share of residuals within 3 σ")
    max_drift: float = Field(
        default=0.05, gt=0, description="a loop that implies more drift per path is rejected [m/m, rad/rad]"
    )
    min_translation: float = Field(default=0.002, gt=0, description="smaller loop errors are not corrected [m]")
    min_rotation: float = Field(default=0.001, gt=0, description="smaller loop errors are not corrected [rad]")
    max_edge_sigma: float = Field(
        default=6.0, gt=0, description="a loop after which a measured motion differs by more is rejected [σ]"
    )


class BundleConfig(_Section):
    """Bundle adjustment: joint poses of the keyframes that see the same place. It needs ``loops.enabled``."""

    enabled: bool = Field(default=True, description="adjust the poses of keyframes to each other")
    window: int = Field(
        default=8, ge=2, description="latest keyframes that move without a revisited place: accuracy for time"
    )
    pairs: int = Field(
        default=10, ge=1, description="earlier keyframes that each new one is matched with: accuracy for time"
    )
    min_translation: float = Field(default=0.002, gt=0, description="smaller corrections do not move the map [m]")
    min_rotation: float = Field(default=0.001, gt=0, description="smaller corrections do not move the map [rad]")


class PoseConfig(_Section):
    """A rigid transform: translation [m] and unit quaternion (w, x, y, z), normalized here."""

    translation: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]

    @model_validator(mode="after")
    def _normalize(self) -> PoseConfig:
        values = (*self.translation, *self.quaternion_wxyz)
        norm = math.hypot(*self.quaternion_wxyz)
        if not all(math.isfinite(value) for value in values) or not 0.5 < norm < 2.0:
            raise ValueError("it needs finite numbers and a quaternion of length 1, as 1 0 0 0")
        w, x, y, z = self.quaternion_wxyz
        self.__dict__["quaternion_wxyz"] = (w / norm, x / norm, y / norm, z / norm)
        return self


class CameraConfig(_Section):
    """A further camera of the map, next to the first one that defines the world.

    ``T_world_camera`` makes it a fixed camera, ``T_first_camera`` one that is carried by the first camera. With neither
    of them it is free: it is tracked on its own. The pose is exact if both standard deviations are 0. Otherwise it is
    the start of an estimate against the map.
    """

    T_world_camera: PoseConfig | None = Field(
        default=None, description="pose of a fixed camera; the world is the first camera in its first frame"
    )
    T_first_camera: PoseConfig | None = Field(
        default=None, description="pose in the frame of the first camera that carries it"
    )
    translation_sigma: float = Field(
        default=0.0, ge=0, le=0.2, description="standard deviation of the pose's translation along each axis [m]"
    )
    rotation_sigma: float = Field(
        default=0.0, ge=0, le=0.35, description="standard deviation of the pose's rotation about each axis [rad]"
    )
    sensor: SensorConfig = Field(default_factory=SensorConfig)

    @property
    def kind(self) -> Literal["fixed", "carried", "free"]:
        """Kind of the camera by the pose that is given."""
        if self.T_world_camera is not None:
            return "fixed"
        return "free" if self.T_first_camera is None else "carried"

    @model_validator(mode="after")
    def _one_pose(self) -> CameraConfig:
        if self.T_world_camera is not None and self.T_first_camera is not None:
            raise ValueError("give T_world_camera or T_first_camera, not both")
        has_sigma = self.translation_sigma > 0 or self.rotation_sigma > 0
        if has_sigma and self.T_world_camera is None and self.T_first_camera is None:
            raise ValueError("a standard deviation needs a pose: T_world_camera or T_first_camera")
        if (self.translation_sigma > 0) != (self.rotation_sigma > 0):
            raise ValueError("give both standard deviations, or none for an exact pose")
        return self


class Config(_Section):
    """All settings of a run.

    ``sensor`` is one object: ``tracking.sensor`` is the same section.
    """

    sensor: SensorConfig = Field(default_factory=SensorConfig)
    tracking: TrackingConfig = Field(default_factory=lambda: TrackingConfig())
    mapping: MappingConfig = Field(default_factory=lambda: MappingConfig())
    loops: LoopsConfig = Field(default_factory=LoopsConfig)
    bundle: BundleConfig = Field(default_factory=BundleConfig)
    cameras: dict[str, CameraConfig] = Field(default_factory=dict, description="further cameras by name")
    seed: int = Field(default=0, description="seed of every random choice")

    @model_validator(mode="after")
    def _share_sensor(self) -> Config:
        if self.tracking.sensor is not self.sensor:
            self.__dict__["tracking"] = self.tracking.model_copy()
            self.tracking.__dict__["sensor"] = self.sensor
        return self

    def of_camera(self, name: str) -> Config:
        """Return the configuration of a camera: that of the run with the camera's own sensor.

        Args:
            name: of a further camera; empty for the first one.
        """
        if not name:
            return self
        sensor = self.cameras[name].sensor
        tracking = self.tracking.model_copy()
        tracking.__dict__["sensor"] = sensor
        return self.model_copy(update={"sensor": sensor, "tracking": tracking})

    def to_yaml(self) -> str:
        """Return the configuration in force as YAML that :func:`splatbot.config.load_config` reads back."""
        import yaml

        from splatbot.config.layout import to_layout

        return yaml.safe_dump(to_layout(self.model_dump(mode="json")), sort_keys=False)
