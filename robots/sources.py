"""Sources of the meshes of the shipped bodies, as packages on PyPI publish them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from splatbot.robots.linkage import SweptHand, sweep
from splatbot.robots.maker_meshes import Source
from splatbot.robots.shapes import Shape
from splatbot.robots.urdf import UrdfReader, parse


@dataclass(frozen=True)
class LinkageSource(Source):
    """A gripper on a linkage, of which the parts "hand" and "finger" are volumes that its meshes sweep.

    See :class:`splatbot.robots.linkage.SweptHand` for their frame.

    Args:
        urdf: file of the linkage, relative to the folder.
    """

    urdf: str = ""

    def shapes(self, part: str, link: int = 0) -> list[Shape]:
        """Compute the swept volume of a part; ``link`` is always 0.

        Raises:
            InputError: a file is missing.
            FormatError: the URDF is damaged.
        """
        swept = _swept(self.path(self.urdf))
        return list(swept.finger if part == "finger" else swept.body)


@cache
def _swept(file: Path) -> SweptHand:
    return sweep(UrdfReader(file, parse(file)))


_LINKS = tuple(f"link{k}" for k in range(8))
_LEVERS = ("inner_finger", "inner_knuckle", "outer_finger", "outer_knuckle")
_MESHES = tuple(f"meshes/{kind}/robotiq_arg2f_85_{part}.obj" for kind in ("collision", "visual") for part in _LEVERS)
_HOUSING = ("meshes/collision/robotiq_arg2f_base_link.obj", "meshes/visual/robotiq_arg2f_85_base_link.obj")
SOURCES: dict[str, Source] = {
    "panda": Source(
        "example-robot-data",
        "panda_description/meshes",
        "franka_description by Franka Robotics",
        "Apache-2.0",
        {part: (f"visual/{part}.dae", f"collision/{part}.stl") for part in (*_LINKS, "hand", "finger")},
    ),
    "2f85": LinkageSource(
        "airo-models",
        "airo_models/grippers/robotiq_2f_85",
        "robotiq_2f_85 of airo-models",
        "MIT",
        {"hand": ("urdf/robotiq_2f_85.urdf", *_HOUSING, *_MESHES), "finger": ("urdf/robotiq_2f_85.urdf", *_MESHES)},
        share={"finger": 0.41},
        urdf="urdf/robotiq_2f_85.urdf",
    ),
}
