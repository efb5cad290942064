"""Addresses of devices: KIND://SERIAL?size=640x480&fps=30."""

from __future__ import annotations

import re
from dataclasses import dataclass

from splatbot.errors import InputError


@dataclass(frozen=True)
class StreamOptions:
    """Requested streams of a device.

    Args:
        width, height: size of both images [px].
        fps: frames per second.

    Raises:
        InputError: a value is out of range.
    """

    width: int = 640
    height: int = 480
    fps: float = 30.0

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("width", self.width, 64, 4096),
            ("height", self.height, 64, 4096),
            ("fps", self.fps, 1, 120),
        ):
            if not low <= value <= high:
                hint = f"give a number in {low}..{high}"
                raise InputError(f"{name} is {value:g}.", field="camera", hint=hint)


def parse_address(uri: str, prefix: str, default: StreamOptions) -> tuple[str, StreamOptions]:
    """Return serial number (or empty) and options of a device's address.

    Args:
        uri: the address.
        prefix: its kind, as in "oak://".
        default: options that the address does not give.

    Raises:
        InputError: an option is unknown, has no value of its kind, or is out of range.
    """
    serial, _, query = uri.removeprefix(prefix).partition("?")
    width, height, fps = default.width, default.height, default.fps
    for pair in filter(None, query.split("&")):
        key, _, text = pair.partition("=")
        size = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
        if key == "size" and size is not None:
            width, height = int(size[1]), int(size[2])
        elif key == "fps" and re.fullmatch(r"\d{1,4}(\.\d{1,6})?", text):
            fps = float(text)
        else:
            hint = f"write {prefix}SERIAL?size={default.width}x{default.height}&fps={default.fps:g}"
            raise InputError(f"has the option {pair!r}.", file=uri, field="camera", hint=hint)
    return serial, StreamOptions(width, height, fps)
