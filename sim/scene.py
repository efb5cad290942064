"""Description of a simulated scene (YAML): a robot, objects, a camera, moving obstacles, and the robot's task."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from splatbot.config import read_yaml
from splatbot.errors import ConfigError
from splatbot.sim.solids import Shape

Vec3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]

_FOLDER = Path(__file__).parent / "scenes"


class Section(BaseModel):
    """A part of a scene; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Waypoint(Section):
    """Position of a moving obstacle at a time."""

    t: NotNegative = Field(description="[s]")
    at: Vec3 = Field(description="[m]")


class SceneObject(Section):
    """A body that is fixed, movable, or carried along a path."""

    name: str = Field(min_length=1, pattern=r"^[^/\s]+$")
    shapes: tuple[Shape, ...] = Field(min_length=1)
    at: Vec3 = (0.0, 0.0, 0.0)
    rpy: Vec3 = Field(default=(0.0, 0.0, 0.0), description="roll, pitch, yaw [rad]")
    movable: bool = Field(default=False, description="free to be pushed, lifted and dropped")
    mass: Positive | None = Field(default=None, description="[kg]; of a movable object, 0.2 if not given")
    friction: NotNegative = Field(default=0.8, description="Coulomb coefficient")
    path: tuple[Waypoint, ...] = Field(default=(), description="waypoints that it follows, forwards and backwards")
    color: Vec3 = Field(default=(0.65, 0.62, 0.58), description="RGB in 0..1")

    @model_validator(mode="after")
    def _fits(self) -> SceneObject:
        soft = [shape.kind == "soft" for shape in self.shapes]
        if any(soft) and len(soft) > 1:
            raise ValueError(f"{self.name}: a soft body has one shape only")
        if self.path and self.movable:
            raise ValueError(f"{self.name}: is carried along a path or movable, not both")
        if any(soft) and (self.path or self.movable):
            raise ValueError(f"{self.name}: a soft body is neither movable nor carried; it lies where it is put")
        if self.movable and any(shape.kind == "plane" for shape in self.shapes):
            raise ValueError(f"{self.name}: a plane has no end and cannot move")
        times = [place.t for place in self.path]
        if self.path and (times[0] != 0 or any(b <= a for a, b in pairwise(times))):
            raise ValueError(f"{self.name}: the times of a path begin at 0 and increase")
        if len(self.path) == 1:
            raise ValueError(f"{self.name}: a path has two places or more")
        return self

    @property
    def soft(self) -> bool:
        """Return whether the object deforms."""
        return self.shapes[0].kind == "soft"


class Motors(Section):
    """Deviations of the arm's drives from ideal ones; 0 and None mean no deviation."""

    rate: Positive = Field(default=1000.0, le=10_000, description="of the controller [Hz]")
    feedforward: bool = Field(default=True, description="the controller knows gravity and the arm's inertia")
    lag: NotNegative = Field(default=0.0, description="time constant of the drives [s]")
    friction: NotNegative = Field(default=0.0, description="dry friction of a joint, as a share of its torque limit")
    backlash: NotNegative = Field(default=0.0, description="play between motor and joint [rad or m]")
    finger_stiffness: Positive | None = Field(default=None, description="of the fingers' servo [N/m]")


class RobotSection(Section):
    """Model and pose of the arm."""

    model: str = "panda"
    at: Vec3 = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    home: tuple[float, ...] = Field(default=(), description="initial joints [rad or m]; empty: the model's own")
    motors: Motors = Motors()


class Medium(Section):
    """Fluid in the scene; MuJoCo's inertia-based drag acts on every moving body."""

    density: NotNegative = Field(default=1.2, description="[kg/m³]; air 1.2")
    viscosity: NotNegative = Field(default=1.8e-5, description="[Pa s]; air 1.8e-5")
    wind: Vec3 = (0.0, 0.0, 0.0)


class LightChange(Section):
    """Brightness of a light from a time on."""

    t: NotNegative
    brightness: NotNegative


class Light(Section):
    """A lamp; ``changes`` switch or dim it."""

    at: Vec3
    brightness: NotNegative = 0.7
    changes: tuple[LightChange, ...] = ()


class CameraSection(Section):
    """A camera in the scene with its simulated sensor effects."""

    at: Vec3
    look_at: Vec3
    width: int = Field(default=320, ge=16, le=2048, description="[px]")
    height: int = Field(default=240, ge=16, le=2048, description="[px]")
    fov_y: float = Field(default=0.8, gt=0.05, lt=2.8, description="vertical field of view [rad]")
    sensor: tuple[str, ...] = Field(default=(), description="sensor effects, `name:option=value,...`")


class Move(Section):
    """Target of the arm at a time: joints, or a pose of the tool."""

    t: Positive = Field(description="[s]")
    joints: tuple[float, ...] = ()
    tcp: Vec3 | None = Field(default=None, description="in the world [m]")
    rpy: Vec3 = Field(default=(3.141592653589793, 0.0, 0.0), description="of the tool [rad]; straight down")
    opening: NotNegative | None = Field(default=None, description="of the gripper [m]; by default unchanged")

    @model_validator(mode="after")
    def _one(self) -> Move:
        if self.joints and self.tcp is not None:
            raise ValueError("give joints or tcp, not both")
        return self


class SceneTask(Section):
    """The task: a kind, which determines the required physics, and the arm's moves."""

    kind: Literal["none", "reach", "push", "grasp", "hang", "wipe", "avoid", "squeeze"] = "none"
    moves: tuple[Move, ...] = ()

    @model_validator(mode="after")
    def _ordered(self) -> SceneTask:
        times = [move.t for move in self.moves]
        if any(b <= a for a, b in pairwise(times)):
            raise ValueError("the times of moves must increase")
        return self


class Clutter(Section):
    """A Gaussian map as surroundings of the robot."""

    file: str
    low: Vec3 = Field(
        default=(-1.2, -1.2, -0.2), description="corner of the part that is used, in the robot's world [m]"
    )
    high: Vec3 = Field(default=(1.2, 1.2, 1.5), description="the opposite corner [m]")
    ellipsoids: int = Field(default=2000, ge=0, le=20_000, description="maximum number: accuracy against time")
    at: Vec3 = Field(default=(0.0, 0.0, 0.0), description="of the map's origin [m]")
    rpy: Vec3 = Field(default=(0.0, 0.0, 0.0), description="of the map's axes: roll, pitch, yaw [rad]")
    support: tuple[float, float, float, float] | None = Field(
        default=None, description="n, d of the support plane n · p + d = 0, n upwards; by default it is estimated"
    )
    movable: bool = Field(default=False, description="whether fitted objects may be moved")
    objects: bool = Field(default=True, description="clusters above the table become primitives or hulls")
    without: tuple[tuple[float, float, float, NotNegative], ...] = Field(
        default=(),
        description="balls (x, y, z, radius) in the robot's world [m] that the map leaves out, since an object of the "
        "scene represents their content",
    )
    harmonics: int = Field(default=0, ge=0, exclude=True, description="degree of its colours, set on loading")


class EffectChoice(Section):
    """Physics and sensor effects that are on or off regardless of the scene's content."""

    force: tuple[str, ...] = ()
    forbid: tuple[str, ...] = ()


class Scene(Section):
    """A whole scene; z is up."""

    name: str
    about: str = ""
    robot: RobotSection | None = RobotSection()
    objects: tuple[SceneObject, ...] = ()
    map: Clutter | None = None
    medium: Medium | None = None
    lights: tuple[Light, ...] = ()
    camera: CameraSection | None = None
    task: SceneTask = SceneTask()
    effects: EffectChoice = EffectChoice()
    timestep: float = Field(default=0.002, gt=0, le=0.05, description="longest step [s]: accuracy for time")
    gravity: Vec3 = (0.0, 0.0, -9.81)
    folder: Path = Field(default=Path(), exclude=True, description="that files are named relative to")

    @model_validator(mode="after")
    def _fits(self) -> Scene:
        names = [obj.name for obj in self.objects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"objects: {twice[0]!r} is there twice")
        if self.task.moves and self.robot is None:
            raise ValueError("task: moves need a robot")
        from splatbot.sim.effects.physics import PHYSICS
        from splatbot.sim.effects.registry import EFFECTS

        for name in (*self.effects.force, *self.effects.forbid):
            if name not in (*PHYSICS, *EFFECTS):
                known = f"physics: {', '.join(PHYSICS)}; of the camera's sensor: {', '.join(EFFECTS)}"
                raise ValueError(f"effects: there is no {name!r}; {known}")
        both = set(self.effects.force) & set(self.effects.forbid)
        if both:
            raise ValueError(f"effects: {min(both)!r} is forced and forbidden")
        return self

    @property
    def movable(self) -> tuple[SceneObject, ...]:
        """Objects that are free to move."""
        return tuple(obj for obj in self.objects if obj.movable)

    @property
    def soft(self) -> tuple[SceneObject, ...]:
        """Objects that deform."""
        return tuple(obj for obj in self.objects if obj.soft)

    @property
    def carried(self) -> tuple[SceneObject, ...]:
        """Obstacles that follow a path."""
        return tuple(obj for obj in self.objects if obj.path)

    def with_effects(self, *, force: Sequence[str] = (), forbid: Sequence[str] = ()) -> Scene:
        """Return the scene with more effects forced or forbidden; the latest choice for an effect applies."""
        forced = [n for n in (*self.effects.force, *force) if n not in forbid]
        forbidden = [n for n in (*self.effects.forbid, *forbid) if n not in force]
        values = self.model_dump() | {"effects": {"force": forced, "forbid": forbidden}, "folder": self.folder}
        return make_scene(values)


def scene_names() -> tuple[str, ...]:
    """Return the names of the scenes that splatbot ships."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_scene(name: str | Path) -> Scene:
    """Load a shipped scene by its name, or a YAML file.

    Raises:
        ConfigError: the scene does not exist or is no YAML mapping, a key is unknown, or a value is out of range.
    """
    path = _FOLDER / f"{name}.yaml" if str(name) in scene_names() else Path(name)
    if not path.suffix:
        raise ConfigError(
            f"there is no scene {str(name)!r}.",
            field="scene",
            hint=f"give a YAML file or one of {', '.join(scene_names())}",
        )
    values = read_yaml(path)
    return make_scene({"name": path.stem, **values, "folder": path.parent}, file=path)


def make_scene(values: dict[str, Any], *, file: str | Path | None = None) -> Scene:
    """Create a scene from its values.

    Raises:
        ConfigError: a key is unknown or a value out of range.
    """
    try:
        return Scene.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"]) or "scene"
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{message}.", file=file, field=field, hint="docs/guide/twin.md lists all keys") from error
