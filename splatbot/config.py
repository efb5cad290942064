"""What a run can be told, in sections; YAML < environment (SPLATBOT_*) < flags; unknown keys are errors."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_serializer, model_validator
from pydantic_core.core_schema import FieldSerializationInfo

from splatbot.errors import ConfigError

_ENV_PREFIX = "SPLATBOT_"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid")


# What a budget buys: the row of the largest budget that is not larger [ms]. Everything that a budget changes is here.
_EFFORT: dict[float, dict[str, Any]] = {
    0: {"n_pixels": 2400, "iterations": 4, "features": "always", "n_features": 500},
    100: {"n_pixels": 4800, "iterations": 8, "features": "always", "n_features": 2000},
    300: {"n_pixels": 9600, "iterations": 10, "features": "always", "n_features": 2000},
    1000: {"n_pixels": 19200, "iterations": 12, "features": "always", "n_features": 2000},
}


class TrackingConfig(_Section):
    """Camera tracking.

    ``budget_ms`` decides ``n_pixels``, ``iterations``, ``features`` and ``n_features`` unless they are given; null
    leaves them to it, and so they are written in YAML.
    """

    budget_ms: float = Field(
        default=100.0, gt=0, description="time for one frame, without decoding it: accuracy for time [ms]"
    )
    deterministic: bool = Field(
        default=True, description="count work instead of milliseconds: the same frames, the same result, bit for bit"
    )
    min_depth: float = Field(default=0.2, gt=0, description="nearer is ignored: a gripper, or too near to measure [m]")
    max_depth: float = Field(default=6.0, gt=0, description="farther depth is ignored [m]")
    max_width: int = Field(default=640, ge=64, description="finest width used for alignment [px]")
    n_levels: int = Field(default=3, ge=1, le=6, description="levels of the pyramid")
    n_pixels: int = Field(default=4800, ge=100, description="pixels per level in alignment: accuracy for time")
    iterations: int = Field(default=8, ge=1, description="Gauss-Newton steps per level: accuracy for time")
    reference_keyframes: int = Field(default=2, ge=1, description="keyframes that a frame is aligned to at once")
    sigma_gray: float = Field(default=0.02, gt=0, description="noise of a grey value in 0..1")
    sigma_depth_floor: float = Field(default=1e-3, gt=0, description="σ_z = floor + quad z² [m]")
    sigma_depth_quad: float = Field(default=2e-3, ge=0, description="σ_z = floor + quad z² [1/m]")
    depth_sigma_scale: float = Field(
        default=10.0,
        ge=1,
        description="beside colour, depth counts as if its σ were so many times as large: filters, calibration and "
        "another moment than the colour's put all of its pixels off together",
    )
    gate: float = Field(default=0.05, gt=0, description="larger depth differences are another surface [m]")
    dense_weight: float = Field(
        default=0.03,
        gt=0,
        le=1,
        description="weight of a dense residual against a feature's: neighbours are correlated",
    )
    dense_share: float = Field(
        default=1.0,
        ge=0,
        le=1,
        description="dense residuals and features are weighed by the spread that they show in each frame, the dense "
        "with this share, for they may err together across the image too; 0: by dense_weight alone",
    )
    features: Literal["always", "needed"] = Field(
        default="always", description="match ORB features on every frame, or only when motion or residual is large"
    )
    n_features: int = Field(default=2000, ge=100, description="ORB keypoints per frame: accuracy for time")
    match_keyframes: int = Field(default=3, ge=1, description="keyframes nearest to the prediction that are matched")
    match_radius: float = Field(
        default=0.06, gt=0, le=1, description="features are looked for this near to their expected place [image width]"
    )
    match_enough: int = Field(
        default=60, ge=20, description="with fewer matches near to their expected place all are matched with all"
    )
    features_motion: float = Field(default=0.03, ge=0, description="predicted motion that calls for features [m]")
    features_rotation: float = Field(default=0.05, ge=0, description="predicted rotation that calls for features [rad]")
    wide: Literal["needed", "never"] = Field(
        default="needed", description="register point clouds where motion is large and features do not help"
    )
    wide_points: int = Field(default=4000, ge=100, description="points of a registered cloud: accuracy for time")
    min_valid: float = Field(
        default=0.02, ge=0, le=1, description="a frame with less valid depth begins no map and is no keyframe"
    )
    min_overlap: float = Field(default=0.15, ge=0, le=1, description="a smaller share of the reference in view: lost")
    min_inliers: float = Field(default=0.3, ge=0, le=1, description="a smaller share of residuals within 3 σ: lost")
    min_eigen_ratio: float = Field(
        default=0.02,
        ge=0,
        le=1,
        description="a smaller ratio of the translation's information: degraded, the prediction stands in",
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
    """Fusion into Gaussians."""

    max_gaussians: int = Field(default=150_000, ge=100, description="hard cap on the map's size: accuracy for time")
    max_width: int = Field(default=640, ge=64, description="width of the images that are fused [px]")
    stride: int = Field(default=3, ge=1, description="one new Gaussian per so many pixels each way: accuracy for time")
    footprint: float = Field(default=1.0, gt=0, description="size of a new Gaussian over the grid's half spacing")
    thickness: float = Field(default=0.2, gt=0, le=1, description="thickness of a Gaussian over its size, at most")
    new_opacity: float = Field(default=0.8, gt=0, lt=1, description="opacity of a new Gaussian")
    new_alpha: float = Field(default=0.6, ge=0, le=1, description="pixels covered less than this are unexplained")
    new_depth: float = Field(default=0.04, gt=0, description="depths that differ by this share are different surfaces")
    solid_alpha: float = Field(default=0.9, ge=0, le=1, description="pixels covered more than this lend their depth")
    keyframe_translation: float = Field(default=0.04, gt=0, description="a view this far from all others is new [m]")
    keyframe_rotation: float = Field(
        default=0.07, gt=0, description="a view turned so far from all others is new [rad]"
    )
    max_keyframes: int = Field(
        default=300, ge=10, description="hard cap on the images kept, some 3 MB each; the most redundant go: memory"
    )
    refine_iterations: int = Field(default=15, ge=0, description="optimiser steps per keyframe: accuracy for time")
    final_iterations: int = Field(default=300, ge=0, description="optimiser steps once the log has ended")
    densify_gradient: float = Field(
        default=3e-4,
        ge=0,
        description="at the end of a log, Gaussians are split whose centres the loss pulls at by more, in the mean, in "
        "pictures 2 wide: accuracy for memory and time",
    )
    window: int = Field(default=8, ge=1, description="latest keyframes that refinement favours")
    depth_weight: float = Field(default=4.0, ge=0, description="weight of relative depth against colour")
    dssim_weight: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="share of structure (1 - SSIM) in the colour loss; 0: colour alone, cheaper",
    )
    rate_means: float = Field(default=5e-4, ge=0, description="learning rate of positions [m]")
    normal_share: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of a position's step that is taken along the normal: depth knows that, a picture guesses it",
    )
    rate_quats: float = Field(default=1e-3, ge=0, description="learning rate of orientations")
    rate_scales: float = Field(default=5e-2, ge=0, description="learning rate of log-scales")
    rate_opacities: float = Field(default=2e-2, ge=0, description="learning rate of opacity logits")
    rate_sh: float = Field(default=2e-2, ge=0, description="learning rate of colour coefficients")
    min_opacity: float = Field(default=0.05, ge=0, le=1, description="fainter Gaussians are pruned")
    max_pixels: float = Field(
        default=6.0, gt=0, description="standard deviations grow no larger in refinement [px of the keyframe]"
    )
    max_scale: float = Field(default=0.5, gt=0, description="larger Gaussians are pruned [m]")
    observe_interval_s: float = Field(
        default=0.2, ge=0, description="between keyframes, a frame as old as this tells what has gone or moves [s]"
    )
    settle: float = Field(default=1.0, ge=0, description="what appeared and has stayed for so long is mapped [s]")
    threaded: bool = Field(
        default=False, description="map in a thread beside tracking: quicker frames, but no two runs are the same"
    )
    still: float = Field(
        default=0.05,
        ge=0,
        description="refinement waits while a joint moves faster than this, if joints are told [rad/s]",
    )
    holdout_every: int = Field(
        default=8, ge=0, description="every n-th frame is tracked, not mapped, and scored; 0: none"
    )


class LoopsConfig(_Section):
    """Places seen again."""

    enabled: bool = Field(default=True, description="look for places seen again and correct the map for drift")
    min_votes: int = Field(default=25, ge=1, description="of 400 descriptors, partners that make a candidate by looks")
    min_matches: int = Field(default=30, ge=20, description="features that agree in one pose, or it is no loop")
    min_overlap: float = Field(default=0.3, ge=0, le=1, description="share of a keyframe that is seen, or it is none")
    min_inliers: float = Field(default=0.5, ge=0, le=1, description="share of residuals within 3 σ, or it is none")
    max_drift: float = Field(
        default=0.05, gt=0, description="a loop that asks for more drift per way is a look-alike [m/m, rad/rad]"
    )
    min_shift: float = Field(default=0.002, gt=0, description="smaller gaps are left as they are [m]")
    min_turn: float = Field(default=0.001, gt=0, description="smaller gaps are left as they are [rad]")
    max_strain: float = Field(default=6.0, gt=0, description="a loop that stretches a measured motion more is none [σ]")


class Config(_Section):
    """Everything a run can be told."""

    tracking: TrackingConfig = Field(default_factory=lambda: TrackingConfig())
    mapping: MappingConfig = Field(default_factory=lambda: MappingConfig())
    loops: LoopsConfig = Field(default_factory=lambda: LoopsConfig())
    seed: int = Field(default=0, description="seed of every random choice")

    def to_yaml(self) -> str:
        """The configuration in force, as YAML that :func:`load_config` reads back."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def load_config(
    path: str | Path | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """The configuration of a YAML file, then the environment, then ``overrides``; the later wins.

    Args:
        path: YAML file; None starts from the defaults.
        overrides: dotted keys, as in ``{"mapping.max_gaussians": 50_000}``.
        environ: variables such as ``SPLATBOT_MAPPING__MAX_GAUSSIANS``; None reads the process's own.

    Raises:
        ConfigError: a file is missing or is no YAML mapping, or a key is unknown or a value out of range.
    """
    values: dict[str, Any] = read_yaml(Path(path)) if path is not None else {}
    for name, text in (os.environ if environ is None else environ).items():
        keys = name.removeprefix(_ENV_PREFIX).lower().split("__")
        if name.startswith(_ENV_PREFIX) and keys[0] in Config.model_fields:
            _assign(values, keys, yaml.safe_load(text))
    for dotted, value in (overrides or {}).items():
        _assign(values, dotted.split("."), value)
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"{first['msg']}.", file=path, field=key, hint="`splatbot map --dump-config` prints all keys and values"
        ) from error


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds; {} of an empty one.

    Raises:
        ConfigError: it cannot be read, is not YAML or no mapping.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror}).", file=path, hint="check the path") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"is not YAML: {error}.", file=path, hint="mend the line it names") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError("is not a mapping of sections.", file=path, hint="write `section: {key: value}`")
    return values


def _assign(values: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        values = values.setdefault(key, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{key} is not a section.", field=".".join(keys))
    values[keys[-1]] = value
