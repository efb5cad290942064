"""`splatbot bench thin`: objects that depth cameras measure badly, against a probe the size of a fingertip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from tyro.conf import arg

from splatbot.bench.benchmark import Benchmark, ReportProgress, Settings
from splatbot.bench.results import Results
from splatbot.bench.tables import Table, per_row
from splatbot.errors import InputError


@dataclass(frozen=True)
class ThinSettings(Settings):
    """Count the surface points that a probe does not find, on rods, cables, wire baskets, glass and black objects.

    Each seeded scan has one object of each kind on a table. The depth has the noise, the edge losses and the occlusions
    of a stereo camera. Dark pixels have no depth, and four fifths of the pixels of glass have none. The probe is a
    sphere of 8 mm at points that two views see. It must collide with the map, or with unknown space under each policy.

    Examples:
        splatbot bench thin
        splatbot bench thin --scans 500
        splatbot bench thin --quick --json figures.json

    Args:
        scans: Number of scans.
        views: Number of views of a scan.
        seed: Seed of the first scan.
    """

    name: ClassVar[str] = "thin"
    quick_values: ClassVar[Mapping[str, Any]] = {"scans": 1, "views": 6}

    scans: Annotated[int, arg(metavar="N")] = 20
    views: Annotated[int, arg(metavar="N")] = 12
    seed: int = 0

    def validate(self) -> None:
        """Raise an InputError for no scan, or for fewer than three views, which confirm nothing."""
        if self.scans < 1 or self.views < 3:
            raise InputError(
                f"are {self.scans}, {self.views}.", field="--scans, --views", hint="give 1 scan and 3 views or more"
            )


def _measure(settings: ThinSettings, report_progress: ReportProgress) -> Results:
    from splatbot.bench.thin.scans import run_scans

    return run_scans(settings, report_progress)


BENCHMARK = Benchmark(
    ThinSettings, _measure, tables=(Table("By kind of object and policy", lambda row: True, layout=per_row),)
)
