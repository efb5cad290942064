"""Shipped arms other than the Panda, fitted to the descriptions of their makers by `splatbot robot fit`.

Each file of this folder is that of :func:`splatbot.robots.store.save_robot`. The descriptions come from packages.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from splatbot.robots.maker_meshes import Source


@dataclass(frozen=True)
class ShippedArm:
    """Source of an arm, and the values that its description lacks.

    Args:
        source: package, its folder and the description as the only part.
        tip: link at the end of the arm.
        home: (J,) posture without self-collision [rad].
        slack: largest distance of the spheres beyond the geometry [m].
        base_slack: the same of the base, which is checked against other links alone. If 0, it is ``slack``.
        hands: of :data:`splatbot.robots.hands.HAND_NAMES` that it can carry.
        efforts: (J,) largest torques [Nm] from the data sheet. If empty, the description has them.
        masses: description of the same arm with inertias. If None, they are in the first one.
    """

    source: Source
    tip: str
    home: tuple[float, ...]
    slack: float
    base_slack: float = 0.0
    hands: tuple[str, ...] = ("2f85", "2f140", "panda_hand")
    efforts: tuple[float, ...] = ()
    masses: Source | None = None


def description_of(source: Source) -> Path:
    """Return the path of an installed description.

    Raises:
        InputError: the package is not installed.
    """
    return source.path(source.parts["description"][0])


def _source(package: str, folder: str, file: str, origin: str, licence: str) -> Source:
    return Source(package, folder, origin, licence, {"description": (file,)})


ARMS = {
    "ur5e": ShippedArm(
        _source("airo-models", "airo_models/arms/ur5e", "ur5e.urdf", "ur_description by Universal Robots", "MIT"),
        tip="wrist_3_link",
        home=(0.0, -1.57, 1.57, -1.57, -1.57, 0.0),
        slack=0.013,
        base_slack=0.03,
    ),
    "xarm6": ShippedArm(
        _source(
            "rtb-data", "armer_xarm/data/xacro/robots/xarm6", "xarm6.xacro", "xarm_ros by UFACTORY",
            "BSD-3-Clause",
        ),
        tip="link_eef",
        home=(0.0, -0.25, -0.8, 0.0, 1.05, 0.0),
        slack=0.015,
    ),
    "xarm7": ShippedArm(
        _source(
            "example-robot-data", "robots/xarm_description/urdf", "xarm7.urdf", "xarm_ros by UFACTORY",
            "BSD-3-Clause",
        ),
        tip="link_eef",
        home=(0.0, -0.25, 0.0, 0.8, 0.0, 1.05, 0.0),
        slack=0.011,
    ),
    "iiwa14": ShippedArm(
        _source(
            "rtb-data", "kuka_lbr_iiwa/urdf", "lbr_iiwa_14_r820.urdf", "kuka_experimental of ROS-Industrial",
            "Apache-2.0",
        ),
        tip="tool0",
        home=(0.0, 0.5, 0.0, -1.3, 0.0, 1.0, 0.0),
        slack=0.0135,
        efforts=(320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0),  # data sheet of the LBR iiwa 14 R820
        masses=_source("pybullet", "pybullet_data/kuka_iiwa", "model.urdf", "iiwa_stack", "BSD-2-Clause"),
    ),
    "so100": ShippedArm(
        _source(
            "example-robot-data", "robots/so_arm_description/urdf", "so100.urdf", "SO-ARM100 by The Robot Studio",
            "Apache-2.0",
        ),
        tip="jaw",
        home=(0.0, 1.57, -1.57, 0.8, 0.0, 0.5),
        slack=0.012,
        hands=(),
    ),
}  # fmt: skip


def arm_file(name: str) -> Path:
    """Return the file of a shipped arm."""
    return Path(__file__).parent / f"{name}.json"
