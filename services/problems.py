"""Every error leaves the service as application/problem+json (RFC 9457)."""

from __future__ import annotations

import errno
import logging
import re
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from splatbot.errors import InputError, SplatbotError

MEDIA_TYPE = "application/problem+json"
_log = logging.getLogger(__name__)

_MAX_ERRORS = 10  # a request with a hundred thousand wrong points names the first ten


class TooLargeError(InputError):
    """A request exceeds the limit of one answer."""

    http_status = 413


class MapNotReadyError(SplatbotError):
    """The map exists and has no published state yet."""

    http_status = 503


class ProblemResponse(JSONResponse):
    """A JSON response of the problem media type."""

    media_type = MEDIA_TYPE


class NotReadyError(SplatbotError):
    """The service does not answer now."""

    http_status = 503


class BusyError(SplatbotError):
    """The service has as much to do as it can; the same request may do later."""

    http_status = 503


class SaveError(SplatbotError):
    """The disk is full, read-only or gone; earlier saved states remain."""

    http_status = 507


DISK_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO, errno.ESTALE})
"""Errors of a disk, which no request can repair."""


def disk_error(error: OSError) -> SaveError:
    """Return the error of a disk that cannot be written to."""
    hint = "free some space and check that the disk is mounted for writing"
    return SaveError(f"The service cannot write to its disk ({error.strerror}).", hint=hint)


def problem(
    status: int,
    detail: str,
    *,
    kind: str | None = None,
    headers: Mapping[str, str] | None = None,
    map_version: int | None = None,
    **more: Any,
) -> ProblemResponse:
    """Return a problem document (RFC 9457).

    Args:
        status: HTTP status.
        detail: the error in one sentence.
        kind: the end of the ``type`` URN; None where the status says it all ("about:blank").
        map_version: version of the map that the request used, if any.
        more: extension members; None is left out.
    """
    body = {
        "type": f"urn:splatbot:problem:{kind}" if kind else "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        "map_version": map_version,
        **more,
    }
    content = {name: value for name, value in body.items() if value is not None}
    return ProblemResponse(content, status_code=status, headers=dict(headers or {}))


def install_problem_handlers(app: FastAPI) -> None:
    """Let every exception of ``app`` leave as a problem document."""
    app.add_exception_handler(SplatbotError, _on_splatbot_error)
    app.add_exception_handler(RequestValidationError, _on_invalid_request)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_exception_handler(ClientDisconnect, _on_client_gone)
    app.add_exception_handler(OSError, _on_os_error)
    app.add_exception_handler(Exception, _on_unexpected_error)


def _on_splatbot_error(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, SplatbotError)
    kind = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", type(error).__name__.removesuffix("Error")).lower()
    # Only the name of a file is shown: clients must not learn the server's paths.
    file = Path(error.file).name if error.file else None
    return problem(
        error.http_status,
        f"{error.field}: {error.message}" if error.field else error.message,
        kind=kind,
        headers={"Retry-After": "1"} if error.http_status in (429, 503) else None,
        map_version=_version(request),
        code=error.code,
        file=file,
        field=error.field,
        hint=error.hint,
    )


def _on_invalid_request(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, RequestValidationError)
    found = error.errors()
    errors = [{"field": ".".join(map(str, e["loc"])), "message": e["msg"]} for e in found[:_MAX_ERRORS]]
    detail = f"{errors[0]['field']}: {errors[0]['message']}" + (f" (and {len(found) - 1} more)" if found[1:] else "")
    return problem(422, detail, kind="validation", map_version=_version(request), errors=errors)


def _on_http_error(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, HTTPException)
    return problem(error.status_code, str(error.detail), headers=error.headers, map_version=_version(request))


def _on_client_gone(request: Request, _error: Exception) -> ProblemResponse:
    return problem(400, "The body was not sent to its end.", map_version=_version(request))  # the client is gone


def _on_os_error(request: Request, error: Exception) -> ProblemResponse:
    assert isinstance(error, OSError)
    if error.errno not in DISK_ERRORS:
        raise error
    _log.error("%s", error)
    return _on_splatbot_error(request, disk_error(error))


def _on_unexpected_error(request: Request, _error: Exception) -> ProblemResponse:
    return problem(500, "The service failed on this request; its log says why.", map_version=_version(request))


def _version(request: Request) -> int | None:
    return getattr(request.state, "map_version", None)
