"""The landing page: status, maps and links, for a browser that opens the address of the service."""

from __future__ import annotations

import html

from fastapi import APIRouter
from fastapi.responses import HTMLResponse

import splatbot
from splatbot.services.dependencies import Service

router = APIRouter(tags=["health"])

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>splatbot</title><style>
:root {{ color-scheme: light dark; --line: #8884; }}
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 0 auto; padding: 1rem; }}
h1 {{ font-size: 1.4rem; }} h2 {{ font-size: 1.05rem; margin-top: 1.5rem; }}
table {{ border-collapse: collapse; width: 100%; }} td, th {{ text-align: left; padding: .3rem .6rem .3rem 0;
border-bottom: 1px solid var(--line); }}
img {{ max-width: 100%; border-radius: .5rem; }} code {{ overflow-wrap: anywhere; }}
.scroll {{ overflow-x: auto; }}
</style></head><body>
<h1>splatbot {version}: {state}</h1>
<p>This service answers questions about maps of 3D Gaussians: distances, collisions, views, plans and grasps.</p>
<h2>Maps</h2>{maps}
<h2>Links</h2><ul>
<li><a href="/docs">/docs</a>: every route with examples, and a form to try it</li>
<li><a href="/v1/maps">/v1/maps</a>: the maps as JSON</li>
<li><a href="/readyz">/readyz</a> and <a href="/metrics">/metrics</a>: readiness, and metrics for Prometheus</li>
<li><code>/rosbridge</code> and <code>/foxglove</code>: WebSockets for roslibjs and Foxglove</li>{viewer}
</ul></body></html>
"""


@router.get("/", response_class=HTMLResponse, include_in_schema=False)
async def landing(service: Service) -> HTMLResponse:
    """Return the page; it names no maps if the service needs a key to read."""
    maps = service.store.list()
    if not maps:
        shown = "<p>There is no map yet.</p>"
    else:
        rows = "".join(_row(m.id, m.state, m.gaussians) for m in maps)
        shown = (
            '<div class="scroll"><table><tr><th>map</th><th>state</th><th>Gaussians</th><th></th></tr>'
            f"{rows}</table></div>"
        )
        shown += _picture(maps[0].id) if maps[0].map_version else ""
    port = service.settings.viewer_port
    viewer = f"<li>viewer in 3D: port {port} of this machine; it asks for the key</li>" if port else ""
    state = "ending" if service.draining else "ready"
    return HTMLResponse(_PAGE.format(version=splatbot.__version__, state=state, maps=shown, viewer=viewer))


def _row(map_id: str, state: str, count: int) -> str:
    name = html.escape(map_id, quote=True)
    links = " ".join(f'<a href="/v1/maps/{name}/{part}">{part}</a>' for part in ("render", "objects"))
    link = f'<a href="/v1/maps/{name}">{name}</a>'
    return f"<tr><td>{link}</td><td>{html.escape(state)}</td><td>{count:,}</td><td>{links}</td></tr>"


def _picture(map_id: str) -> str:
    name = html.escape(map_id, quote=True)
    return f'<p><img src="/v1/maps/{name}/render" alt="the map {name}" width="640" height="480"></p>'
