"""Errors of downloads."""

from __future__ import annotations

from splatbot.errors import SplatbotError


class DownloadError(SplatbotError):
    """A recording cannot be fetched, checked or unpacked."""

    http_status = 502


class ArchiveError(DownloadError):
    """An archive is damaged, or holds more than files of a recording."""
