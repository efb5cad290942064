"""Summary of simulated trials: success rates with intervals, times, sizes, and causes of failure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from splatbot.sim.compare.agreement import wilson
from splatbot.sim.trials.scenes import TrialScene
from splatbot.sim.trials.shake import CONSTANTS as SHAKE
from splatbot.sim.trials.shake import Shake, strength
from splatbot.sim.trials.trial import HELD_OUT, TrialRow
from splatbot.sim.twin import Twin

_MEGA = 1e6
_SAMPLES = 2001  # of the shaking motion


def summaries(rows: Sequence[TrialRow]) -> list[dict[str, Any]]:
    """Summarize each stack, in the order of their first rows."""
    return [summary([row for row in rows if row.stack == name]) for name in dict.fromkeys(row.stack for row in rows)]


def summary(rows: Sequence[TrialRow]) -> dict[str, Any]:
    """Summarize one stack: success in the held-out and the ideal twin with interval and drop, medians, failures."""
    held_out, ideal = (sum(getattr(row, twin).success for row in rows) for twin in ("held_out", "ideal"))
    share = wilson(held_out, len(rows))
    return {
        "stack": rows[0].stack,
        "trials": len(rows),
        "successes": held_out,
        "success": share.value,
        "low": share.low,
        "high": share.high,
        "ideal": ideal / len(rows),
        "drop": (ideal - held_out) / len(rows),
        "touched_others": sum(bool(row.held_out.touched) for row in rows),
        "plan_ms": _median(rows, lambda row: row.plan_ms),
        "grasp_ms": _median(rows, lambda row: row.grasp_ms),
        "build_s": _median(rows, lambda row: row.build_s),
        "world_mb": (_median(rows, lambda row: row.world_bytes) or 0.0) / _MEGA,
        "failures": dict(Counter(row.held_out.failure for row in rows if row.held_out.failure).most_common()),
        "by_kind": _by_kind(rows),
    }


def physics(trial: TrialScene) -> dict[str, Any]:
    """Return the physics parameters of the trials' twins, on which success rates depend."""
    twin = Twin(trial.scene)
    option, robot = twin.world.model.opt, twin.world.robot
    assert robot is not None
    assert robot.gripper is not None
    shake = Shake(robot.chain, robot.home)
    places = robot.tcp(np.array([shake.reference(float(t))[0] for t in np.linspace(0.0, shake.duration, _SAMPLES)]))
    return {
        "finger_force_n": robot.gripper.force,
        "cone": "elliptic" if option.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC) else "pyramidal",
        "impratio": float(option.impratio),
        "timestep_ms": 1e3 * twin.timestep,
        "friction": sorted({obj.friction for obj in trial.scene.movable}),
        "shake_hz": SHAKE.rate,
        "shake_m_s2": round(strength(shake, places[:, :3, 3]), 1),
        "held_out_friction": HELD_OUT.friction,
        "held_out_mass": HELD_OUT.mass,
        "held_out_gain": HELD_OUT.gain,
        "held_out_latency_s": HELD_OUT.latency,
        "held_out_impratio": HELD_OUT.impratio,
        "held_out_softness_s": HELD_OUT.softness,
    }


def table_rows(found: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Format table rows; see :data:`HEAD`."""
    return [
        (
            str(one["stack"]),
            f"{one['successes']} of {one['trials']}",
            f"{100 * one['success']:.1f} ({100 * one['low']:.0f} to {100 * one['high']:.0f})",
            f"{100 * one['ideal']:.1f}",
            f"{100 * one['drop']:+.1f}",
            _number(one["plan_ms"], 1),
            _number(one["grasp_ms"], 0),
            f"{one['world_mb']:.1f}",
            ", ".join(f"{count} {reason}" for reason, count in one["failures"].items()) or "none",
        )
        for one in found
    ]


HEAD = (
    "stack",
    "held",
    "% held-out twin (95 %)",
    "% ideal twin",
    "drop",
    "plan, ms",
    "grasps, ms",
    "world, MB",
    "failures",
)


def _median(rows: Sequence[TrialRow], value: Callable[[TrialRow], float | None]) -> float | None:
    found = [x for x in map(value, rows) if x is not None]
    return float(np.median(found)) if found else None


def _by_kind(rows: Sequence[TrialRow]) -> dict[str, str]:
    kinds = dict.fromkeys(row.kind for row in rows)
    return {
        kind: f"{sum(r.held_out.success for r in rows if r.kind == kind)} of {sum(r.kind == kind for r in rows)}"
        for kind in sorted(kinds)
    }


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
