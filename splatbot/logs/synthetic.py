"""Synthetic logs `synthetic:SCENE?frames=N&...`: ray-cast scenes with exact poses and optional sensor effects."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from urllib.parse import parse_qsl, quote

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError, LogError
from splatbot.frame import Frame
from splatbot.imu import ImuSamples
from splatbot.logs.base import MILLIMETRES, StampedLog
from splatbot.logs.calibration import Calibration
from splatbot.logs.effects import Account, FrameEffects, make_effects
from splatbot.logs.scenes import SCENES, RaycastScene, SceneKind
from splatbot.logs.simulated_imu import SimulatedImu
from splatbot.logs.trajectories import MotionOptions, Path, make_path
from splatbot.trajectory import Trajectory

PREFIX = "synthetic:"

_EFFECT_SAMPLES = 16  # poses per frame for effects of the motion within a frame, which is not uniform


@dataclass(frozen=True)
class SyntheticOptions:
    """Options in the query of a synthetic log.

    Args:
        trajectory: camera trajectory, see :mod:`splatbot.logs.trajectories`; empty for the default of the scene.
        frames: number of recorded frames; an effect may drop some.
        width: [px]; the horizontal field of view stays 62.8°.
        height: [px].
        rate: frame rate [Hz].
        arc: angle of an orbit [deg].
        event: time [s] at which an object moves or vanishes in dynamic scenes.
        seed: seed of hand jitter, of the effects and of the errors of the IMU.
        effects: sensor effects, `name:option=value,...` separated by semicolons.
        imu: rate [Hz] of the simulated inertial sensor (:mod:`splatbot.logs.simulated_imu`); 0 for none.
    """

    trajectory: str = ""
    frames: int = 120
    width: int = 640
    height: int = 480
    rate: float = 30.0
    arc: float = 40.0
    event: float = 2.0
    seed: int = 0
    effects: str = ""
    imu: float = 0.0


_BOUNDS: dict[str, tuple[float, float]] = {
    "frames": (1, 100_000),
    "width": (16, 4096),
    "height": (16, 4096),
    "rate": (0.1, 1000),
    "arc": (0, 120),
    "event": (0, 1e6),
    "seed": (0, 2**32 - 1),
    "imu": (0, 2000),
}


_EXACT = {"stamp_sigma": 0.0, "image_sigma": 0.0, "calibration_error": 0.07e-3}


class SyntheticLog(StampedLog):
    """Frames of a scene, rendered on access without a cache; equal values of ``uri`` give bit-identical frames.

    Raises:
        LogError: the scene, the trajectory, an effect or an option is unknown, or a value is out of range.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.name, _, query = uri.removeprefix(PREFIX).partition("?")
        if self.name not in SCENES:
            raise LogError(
                f"there is no scene {self.name!r}.", file=uri, field="scene", hint=f"scenes: {', '.join(SCENES)}"
            )
        self.options = _parse(uri, query)
        try:
            self.ground_truth = self._path()
            self._effects = self._make_effects()
        except InputError as error:
            raise LogError(error.message, file=uri, field=error.field, hint=error.hint) from error
        self._kept = (
            list(range(self.options.frames)) if self._effects is None else self._effects.kept(self.options.frames)
        )
        if not self._kept:
            raise LogError("no frame is left.", file=uri, field="effects", hint="drop fewer frames, or take more")
        self.stamps = [float(self.ground_truth.stamps[i]) for i in self._kept]

    @cached_property
    def camera(self) -> Camera:
        """An ideal pinhole camera."""
        f, w, h = 525.0 * self.options.width / 640.0, self.options.width, self.options.height
        return Camera(f, f, (w - 1) / 2, (h - 1) / 2, w, h)

    @property
    def calibration(self) -> Calibration:
        """The camera, and a sensor whose calibration is exact but for the rounding of images."""
        return Calibration(self.camera, MILLIMETRES, sensor=_EXACT)

    ground_truth: Trajectory
    """Exact poses T_world_camera of all recorded frames; z is up."""

    @property
    def effects(self) -> list[Account]:
        """Records of the effects that were applied so far."""
        return self._effects.report() if self._effects is not None else []

    @property
    def blanks_depth(self) -> bool:
        """Return whether a frame may have no depth."""
        return self._effects is not None and self._effects.blanks_depth

    @cached_property
    def scene(self) -> RaycastScene:
        """The rendered scene."""
        return self.kind.build(self.options.event)

    def objects(self) -> dict[str, Trajectory]:
        """Return T_world_object of each moving object at the stamps of the kept frames in which it exists."""
        found: dict[str, tuple[list[float], list[NDArray[np.float64]]]] = {}
        for i in self._kept:
            t = float(self.ground_truth.stamps[i])
            for name, T in self.scene.objects(t).items():
                stamps, poses = found.setdefault(name, ([], []))
                stamps.append(t)
                poses.append(T)
        return {name: Trajectory(np.array(stamps), np.array(poses)) for name, (stamps, poses) in found.items()}

    def moving_mask(self, index: int) -> NDArray[np.bool_]:
        """Return the pixels (H, W) of frame ``index`` that show a moving object."""
        i = self._kept[index]
        return self.scene.moving_mask(
            self.camera, self.ground_truth.T_world_camera[i], float(self.ground_truth.stamps[i])
        )

    def _decode(self, index: int) -> Frame:
        i = self._kept[index]
        stamp = float(self.ground_truth.stamps[i])
        rgb, depth = self.scene.render(self.camera, self.ground_truth.T_world_camera[i], stamp)
        frame = Frame(stamp, rgb, depth, self.camera, i, source=f"{self.uri}#{i}", imu=self._imu_samples(index))
        if self._effects is not None:
            frame = self._effects(frame)
        return frame if i == index else replace(frame, index=index)

    @property
    def kind(self) -> SceneKind:
        """The scene's entry in the list of scenes."""
        return SCENES[self.name]

    def _path(self, samples: int = 1) -> Trajectory:
        """Sample the camera path at the frames, and at ``samples - 1`` equally spaced times between two of them."""
        o, path = self.options, self._motion()
        stamps = np.arange((o.frames - 1) * samples + 1) / (o.rate * samples)
        return Trajectory(stamps, np.array([path(float(t)) for t in stamps]))

    def _motion(self) -> Path:
        o = self.options
        motion = MotionOptions((o.frames - 1) / o.rate, o.rate, np.radians(o.arc), o.seed)
        return make_path(o.trajectory or self.kind.trajectory, self.kind.stage, motion)

    @cached_property
    def _imu(self) -> SimulatedImu | None:
        return SimulatedImu(self._motion(), self.options.imu, self.options.seed) if self.options.imu else None

    def _imu_samples(self, index: int) -> ImuSamples | None:
        """Return the samples since the kept frame before a frame; at the first one, the sample at its stamp."""
        if self._imu is None:
            return None
        after = self.stamps[index - 1] if index else self.stamps[0] - 1 / self.options.imu
        return self._imu.samples(after, self.stamps[index])

    def _make_effects(self) -> FrameEffects | None:
        specs = [spec.strip() for spec in self.options.effects.split(";") if spec.strip()]
        if not specs:
            return None
        return make_effects(specs, seed=self.options.seed).along(self._path(_EFFECT_SAMPLES))


def read_options(uri: str) -> SyntheticOptions:
    """Read the options in the address of a synthetic log; no scene is built.

    Raises:
        LogError: an option is unknown, or a value out of range.
    """
    return _parse(uri, uri.partition("?")[2])


def synthetic_uri(scene: str, options: SyntheticOptions) -> str:
    """Return the address of a scene with ``options``; default values are omitted."""
    plain = asdict(SyntheticOptions())
    query = [
        f"{key}={quote(str(value), safe=':;,=. ')}" for key, value in asdict(options).items() if value != plain[key]
    ]
    return PREFIX + scene + ("?" + "&".join(query) if query else "")


def _parse(uri: str, query: str) -> SyntheticOptions:
    kinds = {name: type(value) for name, value in asdict(SyntheticOptions()).items()}
    values: dict[str, float | str] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in kinds:
            raise LogError("is unknown.", file=uri, field=key, hint=f"options: {', '.join(kinds)}")
        values[key] = _number(uri, key, text, kinds[key]) if key in _BOUNDS else text
    return SyntheticOptions(**values)  # type: ignore[arg-type]


def _number(uri: str, key: str, text: str, kind: type) -> float:
    low, high = _BOUNDS[key]
    try:
        value: float = kind(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise LogError(f"is {text!r}.", file=uri, field=key, hint=f"give a number in {low:g}..{high:g}")
    return value
