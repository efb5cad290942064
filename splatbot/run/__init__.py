"""A whole log through SLAM, saved, scored and reported."""

from splatbot.run.mapping import Progress, RunResult, map_log

__all__ = ["Progress", "RunResult", "map_log"]
