"""The same call handed to gsplat, where there is a CUDA device."""

from __future__ import annotations

import importlib
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError


def rasterization_gsplat(**arguments: Any) -> tuple[Tensor, Tensor, Any]:
    """Call ``gsplat.rasterization(**arguments)``; arguments are not moved between devices.

    Raises:
        InputError: gsplat is not installed, or there is no CUDA device.
    """
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        raise InputError(
            f"'gsplat' cannot be imported ({error}).", field="backend", hint="pip install gsplat, or backend='native'"
        ) from error
    if not torch.cuda.is_available():
        raise InputError("'gsplat' needs a CUDA device.", field="backend", hint="use backend='native'")
    renders, alphas, meta = gsplat.rasterization(**arguments)
    return renders, alphas, meta
