"""Sweeps of compile-time constants of the C++ core: degree of the exponential, shape of the tiles.

Run as a module, it measures one such build and prints JSON.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import splatbot
from splatbot.bench.benchmark import ReportProgress
from splatbot.bench.results import Results
from splatbot.errors import NativeError

_SOURCE = Path(splatbot.__file__).parent / "native"
_ISA = "v4"


@dataclass(frozen=True)
class Variant:
    """A value of a knob and the CMake option that sets it."""

    knob: str
    value: str
    option: str
    default: bool = False


VARIANTS = (
    Variant("exp degree", "1", "-DSPLATBOT_EXP_DEGREE=1"),
    Variant("exp degree", "2", "-DSPLATBOT_EXP_DEGREE=2", default=True),
    Variant("exp degree", "3", "-DSPLATBOT_EXP_DEGREE=3"),
    Variant("tile", "16x16", "-DSPLATBOT_TILE=16x16"),
    Variant("tile", "16x32", "-DSPLATBOT_TILE=16x32"),
    Variant("tile", "32x16", "-DSPLATBOT_TILE=32x16", default=True),
)


@dataclass(frozen=True)
class MeasuredVariant:
    """Times of one build [ms] on the surface map at 320x240, RGB and expected depth.

    Args:
        largest_error: of a small image's colours and depths against the float64 reference, where no rounding can flip.
    """

    forward_ms: float
    forward_backward_ms: float
    blend_ms: float
    largest_error: float


def run_variants(results: Results, *, threads: int, report_progress: ReportProgress) -> None:
    """Build and measure every variant (a minute or two each); rows name those that could not be built and why."""
    for variant in VARIANTS:
        case = f"sweep {variant.knob} (AVX-512): {variant.value}{' (default)' if variant.default else ''}"
        report_progress(f"building {variant.knob} {variant.value}")
        try:
            measured = _build_and_measure(variant, threads)
        except NativeError as error:
            results.add(case, "forward", None, "ms", note=str(error).splitlines()[0])
            continue
        results.add(case, "forward", measured.forward_ms, "ms")
        results.add(case, "forward+backward", measured.forward_backward_ms, "ms")
        results.add(case, "stage blend", measured.blend_ms, "ms")
        results.add(case, "largest error", measured.largest_error, "")


def _build_and_measure(variant: Variant, threads: int) -> MeasuredVariant:
    with tempfile.TemporaryDirectory(prefix="splatbot-variant-") as folder:
        build, out = Path(folder) / "build", Path(folder) / "out"
        _run(
            "cmake",
            *("-S", str(_SOURCE), "-B", str(build), f"-DPython_EXECUTABLE={sys.executable}"),
            *(f"-DCMAKE_LIBRARY_OUTPUT_DIRECTORY={out}", f"-DSPLATBOT_ISAS={_ISA}", variant.option),
        )
        _run("cmake", "--build", str(build), "--target", "_native", "--parallel", "2")
        [module] = out.glob("_native*")
        text = _run(sys.executable, "-m", "splatbot.bench.raster.variants", str(module), str(threads))
        return MeasuredVariant(**json.loads(text))


def _run(*command: str) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise NativeError(f"{command[0]} is not installed.", hint="install CMake and a C++ compiler") from error
    if done.returncode != 0:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise NativeError(f"{command[0]} failed: {last}", file=str(_SOURCE), hint="run it from a checkout")
    return done.stdout


def measure_module(path: Path, threads: int) -> MeasuredVariant:
    """Measure an extension module in place of the installed one; for a process of its own."""
    spec = importlib.util.spec_from_file_location("splatbot._native", path)
    if spec is None or spec.loader is None:
        raise NativeError("is no extension module.", file=path, hint="build it with CMake")
    module = importlib.util.module_from_spec(spec)
    sys.modules["splatbot._native"] = module
    spec.loader.exec_module(module)
    from splatbot.bench.raster.scenes import surface_map
    from splatbot.bench.raster.speed import Passes
    from splatbot.bench.raster.sweeps import error_against_reference
    from splatbot.bench.timing import measure
    from splatbot.bench.timing import threads as on_threads

    with on_threads(threads):
        passes = Passes(surface_map(), (320, 240))
        forward = measure(passes.forward, runs=60)
        both = measure(passes.forward_backward, runs=60)
        return MeasuredVariant(
            forward.least_ms, both.least_ms, passes.best_work(20).blend_ms, error_against_reference()
        )


if __name__ == "__main__":
    print(json.dumps(asdict(measure_module(Path(sys.argv[1]), int(sys.argv[2])))))
