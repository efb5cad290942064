"""Samples of an inertial sensor on a camera: angular rates and specific forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Samples of a gyroscope and an accelerometer in the axes of a camera (x right, y down, z forward).

    The two sensors have their own stamps, because their rates differ. The samples are sorted by stamp. Those that are
    not finite are left out, and so are those that repeat a stamp: drivers repeat the last sample of the slower sensor.

    Args:
        gyro_stamps: (N,) [s], on the clock of the frames.
        angular_rate: (N, 3) [rad/s].
        accel_stamps: (M,) [s], on the same clock.
        specific_force: (M, 3) [m/s²]. A camera at rest measures 9.81 m/s² upwards.

    Raises:
        InputError: the shapes do not fit.
    """

    gyro_stamps: Array
    angular_rate: Array
    accel_stamps: Array
    specific_force: Array

    def __post_init__(self) -> None:
        for stamps, values in (("gyro_stamps", "angular_rate"), ("accel_stamps", "specific_force")):
            t, x = _usable(stamps, values, getattr(self, stamps), getattr(self, values))
            object.__setattr__(self, stamps, t)
            object.__setattr__(self, values, x)

    @classmethod
    def of(cls, gyroscope: ArrayLike = (), accelerometer: ArrayLike = ()) -> ImuSamples:
        """Return the samples of rows (N, 4) and (M, 4): stamp [s], then rates [rad/s] or specific forces [m/s²].

        Raises:
            InputError: a row has not 4 numbers.
        """
        gyro, accel = _rows("gyroscope", gyroscope), _rows("accelerometer", accelerometer)
        return cls(gyro[:, 0], gyro[:, 1:], accel[:, 0], accel[:, 1:])

    @property
    def gyroscope(self) -> Array:
        """Rows (N, 4): stamp [s] and angular rate [rad/s]."""
        return np.column_stack([self.gyro_stamps, self.angular_rate])

    @property
    def accelerometer(self) -> Array:
        """Rows (M, 4): stamp [s] and specific force [m/s²]."""
        return np.column_stack([self.accel_stamps, self.specific_force])

    def between(self, after: float, until: float) -> ImuSamples:
        """Return the samples with ``after < stamp <= until`` [s]."""
        gyro, accel = (
            slice(*np.searchsorted(stamps, [after, until], side="right"))
            for stamps in (self.gyro_stamps, self.accel_stamps)
        )
        return ImuSamples(
            self.gyro_stamps[gyro], self.angular_rate[gyro], self.accel_stamps[accel], self.specific_force[accel]
        )

    def shifted(self, seconds: float) -> ImuSamples:
        """Return the samples with a time [s] added to their stamps."""
        return ImuSamples(
            self.gyro_stamps + seconds, self.angular_rate, self.accel_stamps + seconds, self.specific_force
        )

    def joined(self, other: ImuSamples | None) -> ImuSamples:
        """Return these samples with further ones; of two with one stamp, that of this object stays."""
        if other is None:
            return self
        return ImuSamples(
            np.concatenate([self.gyro_stamps, other.gyro_stamps]),
            np.concatenate([self.angular_rate, other.angular_rate]),
            np.concatenate([self.accel_stamps, other.accel_stamps]),
            np.concatenate([self.specific_force, other.specific_force]),
        )


def _rows(name: str, rows: ArrayLike) -> Array:
    table = np.asarray(rows, np.float64)
    if table.size == 0:
        return np.zeros((0, 4))
    if table.ndim != 2 or table.shape[1] != 4:
        raise InputError(f"has the shape {table.shape}.", field=f"imu {name}", hint="give rows of stamp, x, y, z")
    return table


def _usable(stamps_name: str, name: str, stamps: ArrayLike, values: ArrayLike) -> tuple[Array, Array]:
    """Return sorted stamps (N,) and values (N, 3) without repeated stamps and values that are not finite."""
    t, x = np.asarray(stamps, np.float64), np.asarray(values, np.float64)
    if t.ndim != 1 or x.shape != (len(t), 3):
        hint = f"give {stamps_name} (N,) and {name} (N, 3)"
        raise InputError(f"is {x.shape} for stamps {t.shape}.", field=f"imu {name}", hint=hint)
    if len(t) == 0:
        return t, x
    finite = np.isfinite(t) & np.isfinite(x).all(axis=1)
    if finite.all() and (np.diff(t) > 0).all():
        return t, x
    t, first = np.unique(t[finite], return_index=True)
    return t, x[finite][first]
