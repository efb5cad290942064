"""Estimated quantity of a calibration with its uncertainty, or the reason why a log does not determine it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """One calibrated quantity.

    Args:
        value: estimate.
        sigma: its standard deviation.
        unit: unit of both.
        refusal: reason why the log does not determine the quantity. Empty if it does.
    """

    value: float
    sigma: float
    unit: str
    refusal: str = ""

    @property
    def significant(self) -> float:
        """The value, or 0 if 0 is within two standard deviations of it."""
        return self.value if abs(self.value) > 2.0 * self.sigma else 0.0

    @classmethod
    def limited(cls, value: float, sigma: float, unit: str, largest_sigma: float, need: str) -> Estimate:
        """Return the estimate, refused if its standard deviation exceeds ``largest_sigma``.

        Args:
            value: estimate.
            sigma: its standard deviation; NaN is too large.
            unit: unit of both.
            largest_sigma: largest standard deviation of a useful estimate.
            need: motion that a log must contain for it.
        """
        if sigma <= largest_sigma:
            return cls(value, sigma, unit)
        deviation = f"{sigma:.2g} {unit}".rstrip()
        return cls(value, sigma, unit, f"its standard deviation is {deviation}: {need}")
