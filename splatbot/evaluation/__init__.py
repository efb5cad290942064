"""Error measures of trajectories, images and depth images."""

from splatbot.evaluation.consistency import Consistency, nees
from splatbot.evaluation.geometry import DepthError, depth_error
from splatbot.evaluation.image import psnr, ssim
from splatbot.evaluation.registration import depth_offset
from splatbot.evaluation.trajectory import AbsoluteError, RelativeError, absolute_error, align, relative_error

__all__ = [
    "AbsoluteError",
    "Consistency",
    "DepthError",
    "RelativeError",
    "absolute_error",
    "align",
    "depth_error",
    "depth_offset",
    "nees",
    "psnr",
    "relative_error",
    "ssim",
]
