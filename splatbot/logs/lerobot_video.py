"""Videos of LeRobot datasets: colour, and depth as 12-bit codes (LeRobot 0.6, depth_utils)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.logs.images import depth_in_metres

_CODE_BITS = 12
_LAST_CODE = 4095
_AHEAD = 1.0  # [s] that are decoded on the way to a later frame; beyond it, the nearest key frame is sought
_BACK = 1.0  # [s] within which frames are stored out of order
_PADDING = 128  # [px] by which coded images may be larger
_AGAIN = "copy or download the dataset again"


@dataclass(frozen=True)
class DepthCodes:
    """Quantization of depth to 12-bit codes, logarithmic or linear.

    Code 0 is all depth up to ``depth_min``, and code 4095 all depth from ``depth_max``. Both are read as missing.

    Args:
        depth_min: [m] depth of code 0.
        depth_max: [m] depth of code 4095.
        shift: [m] that is added to depth before its logarithm.
        use_log: whether codes are logarithmic.
    """

    depth_min: float = 0.01
    depth_max: float = 10.0
    shift: float = 3.5
    use_log: bool = True

    @cached_property
    def metres(self) -> NDArray[np.float32]:
        """Depth (4096,) [m] of each code, 0 where it is missing."""
        share = np.arange(_LAST_CODE + 1) / _LAST_CODE
        if self.use_log:
            low, high = math.log(self.depth_min + self.shift), math.log(self.depth_max + self.shift)
            depth = np.exp(low + share * (high - low)) - self.shift
        else:
            depth = self.depth_min + share * (self.depth_max - self.depth_min)
        depth[[0, -1]] = 0
        return depth.astype(np.float32)


class VideoFrames:
    """Frames of a part of a video by their times; any order of access is possible, one frame is kept in memory.

    Args:
        path: the file.
        times: time [s] of each frame in the video (N,).
        tolerance: [s] by which the time of a frame may differ.
        size: width and height [px] of the images.
        codes: quantization of depth.

    Raises:
        LogError: the file is missing or damaged, or its images have another size.
    """

    def __init__(
        self, path: Path, times: NDArray[np.float64], tolerance: float, size: tuple[int, int], codes: DepthCodes
    ) -> None:
        self._path, self._times, self._tolerance, self._codes = path, times, tolerance, codes
        try:
            # The format is given, since files of other formats may name further files to open.
            self._container = av.open(str(path.absolute()), format="mp4", metadata_errors="replace")
            self._stream = self._container.streams.video[0]
        except (av.FFmpegError, OSError, IndexError) as error:
            problem = "does not exist." if not path.exists() else f"is no whole MP4 video ({error})."
            raise LogError(problem, file=path, field="video", hint=_AGAIN) from error
        if self._stream.codec_context is None:
            raise LogError("has an unknown codec.", file=path, field="video", hint=_AGAIN)
        found, self._size = (self._stream.width, self._stream.height), size
        if found != size:
            problem = f"is {found[0]}x{found[1]}; the intrinsics are for {size[0]}x{size[1]}."
            hint = "give the intrinsics of this image size"
            raise LogError(problem, file=path, field="image size", hint=hint)
        most = (size[0] + _PADDING) * (size[1] + _PADDING)
        self._stream.codec_context.thread_count = 1  # with more, an error takes frames with it that precede it
        self._stream.codec_context.options = {"max_pixels": str(most), "err_detect": "explode"}
        self._frames: Iterator[tuple[float, VideoFrame]] = iter(())
        self._current: tuple[float, VideoFrame] | None = None

    def color(self, frame: int, source: Path) -> NDArray[np.uint8]:
        """Decode colour (H, W, 3) of a frame; ``source`` names it in errors.

        Raises:
            LogError: it is damaged or missing.
        """
        return np.asarray(self._decoded(frame, source, "colour").to_ndarray(format="rgb24"), np.uint8)

    def depth(self, frame: int, source: Path) -> NDArray[np.float32]:
        """Decode depth (H, W) [m] of a frame; see :meth:`color`."""
        image = self._decoded(frame, source, "depth")
        bits = image.format.components[0].bits
        if bits < _CODE_BITS:
            problem = f"is a video of {bits} bits; depth has {_CODE_BITS}."
            raise LogError(problem, file=source, field="depth", hint="record the dataset with LeRobot 0.6 or later")
        codes = np.asarray(image.to_ndarray(format="gray12le"), np.int64)
        return depth_in_metres(self._codes.metres.take(codes, mode="clip"), 1.0, source)

    def _decoded(self, index: int, source: Path, field: str) -> VideoFrame:
        time = float(self._times[index])
        try:
            found, frame = self._advance(time)
        except StopIteration as error:
            self._current = None
            raise LogError("is beyond the end of the video.", file=source, field=field, hint=_AGAIN) from error
        except (av.FFmpegError, ValueError, OverflowError) as error:
            self._current = None
            raise LogError(f"is damaged ({error}).", file=source, field=field, hint=_AGAIN) from error
        if found > time + self._tolerance:
            raise LogError(f"the video has no image at {time:.4f} s.", file=source, field=field, hint=_AGAIN)
        if frame.is_corrupt or (frame.width, frame.height) != self._size:
            raise LogError("is damaged.", file=source, field=field, hint=_AGAIN)
        return frame

    def _advance(self, time: float) -> tuple[float, VideoFrame]:
        """Decode up to the first frame that is not before a time [s]; returns its time [s] with it."""
        earliest, latest = time - self._tolerance, time + self._tolerance
        current = self._current
        if current is None or not earliest - _AHEAD <= current[0] <= latest:
            self._seek(latest)
            current = next(self._frames, None)
            if current is None or current[0] > latest:  # the key frame found is stored before, yet shown after it
                self._seek(latest - _BACK)
                current = next(self._frames)
        while current[0] < earliest:
            current = next(self._frames)
        self._current = current
        return current

    def _seek(self, time: float) -> None:
        base = self._stream.time_base
        if base is None:
            raise ValueError("the video has no clock")
        self._container.seek(max(0, int(time / base)), stream=self._stream, backward=True)
        self._frames = ((float(f.pts * base), f) for f in self._decode() if f.pts is not None)

    def _decode(self) -> Iterator[VideoFrame]:
        """Decode the frames from the current position; those before a damaged one precede its error."""
        decoder = self._stream.codec_context
        for packet in self._container.demux(self._stream):
            try:
                frames = decoder.decode(packet)
            except av.FFmpegError:
                yield from decoder.decode(None)
                raise
            yield from frames
