"""The scope that each route needs."""

from __future__ import annotations

import re

from starlette.requests import HTTPConnection

from splatbot.errors import SplatbotError
from splatbot.services.keys import Scope

NEEDS: dict[tuple[str, str], Scope] = {
    ("POST", "/v1/maps"): "map",
    ("DELETE", "/v1/maps/{map_id}"): "map",
    ("POST", "/v1/maps/{map_id}/upload"): "map",
    ("POST", "/v1/maps/{map_id}/frames"): "map",
    ("POST", "/v1/maps/{map_id}/end"): "map",
    ("POST", "/v1/maps/{map_id}/resync"): "map",
    ("POST", "/v1/maps/{map_id}/versions"): "map",
    ("POST", "/v1/maps/{map_id}/versions/{number}/restore"): "map",
    ("DELETE", "/v1/maps/{map_id}/versions/{number}"): "map",
    ("POST", "/v1/maps/{map_id}/merge"): "map",
    ("POST", "/v1/maps/{map_id}/diff"): "read",
    ("POST", "/v1/maps/{map_id}/distance"): "read",
    ("POST", "/v1/maps/{map_id}/collisions"): "read",
    ("POST", "/v1/maps/{map_id}/render"): "read",
    ("POST", "/v1/maps/{map_id}/views"): "read",
    ("POST", "/v1/maps/{map_id}/plans"): "read",
    ("POST", "/v1/maps/{map_id}/grasps"): "read",
    ("PUT", "/v1/maps/{map_id}/held"): "map",
    ("POST", "/v1/robots/{robot}/joints"): "map",
    ("POST", "/v1/ik"): "read",
    ("POST", "/v1/picks"): "map",
    ("POST", "/v1/sim/trials"): "map",
    ("DELETE", "/v1/jobs/{job_id}"): "map",
    ("POST", "/v1/arms/{name}/lease"): "move",
    ("PUT", "/v1/leases/{lease_id}"): "move",
    ("DELETE", "/v1/leases/{lease_id}"): "move",
    ("POST", "/v1/trajectories"): "move",
    ("DELETE", "/v1/trajectories/{job_id}"): "move",
    ("POST", "/v1/stop"): "read",  # a stop adds no danger
    ("DELETE", "/v1/stop"): "move",
}
"""Scopes of the routes that are not GET; a test checks that each route is here."""

_FORMS = [(verb, re.compile(re.sub(r"\{\w+\}", "[^/]+", path)), need) for (verb, path), need in NEEDS.items()]


class ScopeError(SplatbotError):
    """The client's key lacks a scope."""

    http_status = 403


class NoKeyError(SplatbotError):
    """The client has no key and needs one."""

    http_status = 401


def needed(method: str, path: str) -> Scope:
    """Return the scope that a route needs: GET reads, and a route that is not listed is an administrator's."""
    return NEEDS.get((method, path), "read" if method in ("GET", "HEAD") else "admin")


def scope_error(scope: Scope, has_key: bool) -> SplatbotError:
    """Return the error of a client without a scope."""
    if not has_key:
        hint = "send Authorization: Bearer KEY; `splatbot serve` names the file of the key at its start"
        return NoKeyError(f"This needs a key with the scope {scope!r}.", hint=hint)
    hint = f"make another: splatbot serve --new-key --scopes read,{scope}"
    return ScopeError(f"The key lacks the scope {scope!r}.", hint=hint)


def listed_scope(method: str, path: str) -> Scope | None:
    """Return the scope of the listed route of a path, before the request is routed; None if none is listed."""
    return next((need for verb, form, need in _FORMS if verb == method and form.fullmatch(path)), None)


async def check_scope(connection: HTTPConnection) -> None:
    """Check that the client has the scope of the route; a dependency of every route.

    Raises:
        ScopeError: its key lacks the scope.
        NoKeyError: it has no key.
    """
    scope, state = connection.scope, connection.state
    if scope["type"] != "http":
        return  # a session checks each operation
    scope_needed = needed(scope["method"], scope["route"].path)
    if scope_needed not in state.scopes:
        raise scope_error(scope_needed, state.has_key)
