"""Bodies of requests and answers."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Mode = Literal["rgb", "depth", "normal", "alpha"]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Health(BaseModel):
    """Whether the process lives, or is ready to answer."""

    status: Literal["ok", "ready"]
    version: str = Field(description="of splatbot")
    maps: dict[str, int] = Field(default_factory=dict, description="map_version by map id")


class Bounds(BaseModel):
    """Axis-aligned box around the Gaussians' centres, world frame [m]."""

    low: Vector3
    high: Vector3


class MapInfo(BaseModel):
    """A map as it is now."""

    id: str
    map_version: int = Field(description="grows with every published state; 0: nothing yet")
    state: Literal["static", "mapping", "ended", "failed"]
    detail: str | None = Field(None, description="why mapping failed")
    source: str
    gaussians: int
    bytes: int
    sh_degree: int
    stamp: float = Field(description="time of the last frame in the map [s]")
    bounds: Bounds | None = Field(None, description="null while the map is empty")


class MapList(BaseModel):
    """All maps."""

    maps: list[MapInfo]


class DistanceRequest(_Request):
    """Points to be asked about."""

    points: list[Vector3] = Field(description="(P, 3), world frame [m]")
    n_sigma: Annotated[float, Field(gt=0, allow_inf_nan=False)] = Field(
        2.0, description="standard deviations at which a Gaussian's surface is taken to be"
    )


class DistanceAnswer(BaseModel):
    """One entry per point."""

    map_version: int
    n_sigma: float
    distance: list[float | None] = Field(description="standard deviations from the nearest Gaussian; null: empty map")
    index: list[int] = Field(description="that Gaussian's row in the map; -1: empty map")
    inside: list[bool] = Field(description="distance <= n_sigma")


class CameraIn(_Request):
    """Pinhole intrinsics [px]; integer coordinates are pixel centres, as in OpenCV."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class RenderRequest(_Request):
    """A view to be drawn. The pose is a matrix, or a translation and a quaternion, or left out for the default view."""

    mode: Mode = "rgb"
    camera: CameraIn | None = Field(None, description="default: 640x480 pixels, 60 degrees wide")
    T_world_camera: tuple[Vector4, Vector4, Vector4, Vector4] | None = Field(None, description="(4, 4), row by row")
    translation: Vector3 | None = Field(None, description="camera centre, world frame [m]")
    quat_wxyz: Vector4 | None = Field(None, description="rotation of T_world_camera")
    depth_range_m: tuple[float, float] | None = Field(None, description="colours of mode depth; default: 2..98 %")

    @model_validator(mode="after")
    def _one_pose(self) -> Self:
        if (self.translation is None) != (self.quat_wxyz is None):
            raise ValueError("give translation and quat_wxyz together")
        if self.T_world_camera is not None and self.translation is not None:
            raise ValueError("give either T_world_camera or translation and quat_wxyz")
        return self
