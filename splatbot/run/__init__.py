"""A whole log through SLAM, saved, scored and reported."""

from splatbot.run.job import RunResult, map_log
from splatbot.run.progress import Progress

__all__ = ["Progress", "RunResult", "map_log"]
