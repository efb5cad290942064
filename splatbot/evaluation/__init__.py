"""How good a trajectory, an image or a depth image is."""

from splatbot.evaluation.geometry import DepthError, depth_error
from splatbot.evaluation.image import psnr, ssim
from splatbot.evaluation.trajectory import AbsoluteError, RelativeError, absolute_error, align, relative_error

__all__ = [
    "AbsoluteError",
    "DepthError",
    "RelativeError",
    "absolute_error",
    "align",
    "depth_error",
    "psnr",
    "relative_error",
    "ssim",
]
