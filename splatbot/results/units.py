"""Readable numbers with units; a dash for a missing value."""

from __future__ import annotations

import math

NONE = "-"


def metres(value: float | None) -> str:
    """Format a length [m] in mm, cm or m."""
    if value is None:
        return NONE
    if abs(value) < 0.02:
        return f"{1e3 * value:.2f} mm"
    return f"{1e2 * value:.2f} cm" if abs(value) < 1.0 else f"{value:.2f} m"


def millimetres(value: float | None) -> str:
    """Format a length [m] in mm, for columns of lengths of different sizes."""
    return NONE if value is None else f"{1e3 * value:,.2f} mm"


def degrees(value: float | None) -> str:
    """Format an angle [rad] in degrees."""
    return NONE if value is None else f"{math.degrees(value):.2f}°"


def milliseconds(value: float | None) -> str:
    """Format a time [ms] in ms, or in s from 10 s on."""
    if value is None:
        return NONE
    if value >= 1e4:
        return f"{value / 1e3:.1f} s"
    return f"{value:.0f} ms" if value >= 100 else f"{value:.1f} ms"


def decibels(value: float | None) -> str:
    """Format a ratio [dB]."""
    return NONE if value is None else f"{value:.1f} dB"


def percent(value: float | None) -> str:
    """Format a fraction 0..1 in %."""
    return NONE if value is None else f"{100 * value:.0f} %"


def count(value: int | None) -> str:
    """Format a number with thousands separators."""
    return NONE if value is None else f"{value:,}"


def megabytes(value: float | None) -> str:
    """Format bytes in MB (10⁶ bytes), in GB from 1000 MB on, or in kB below 0.1 MB."""
    if value is None:
        return NONE
    if value < 1e5:
        return f"{value / 1e3:.1f} kB"
    return f"{value / 1e9:.2f} GB" if value >= 1e9 else f"{value / 1e6:.1f} MB"


def number(value: float | None, digits: int) -> str:
    """Format a number with ``digits`` decimals."""
    return NONE if value is None else f"{value:.{digits}f}"
