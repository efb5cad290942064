"""The page /docs in Chromium, which reaches no other host."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from splatbot.services.settings import ServiceSettings
from tests.browser.chromium import Chromium
from tests.contracts.conftest import running

pytestmark = [pytest.mark.long, pytest.mark.alone]


def test_the_docs_list_the_routes_without_another_host(tmp_path: Path) -> None:
    nowhere = "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"
    with running(ServiceSettings()) as service, Chromium(tmp_path, flags=(nowhere,)) as browser:
        browser.open(f"{service.url}/docs")
        for _ in range(300):
            time.sleep(0.1)
            if (shown := browser.evaluate("document.querySelectorAll('.opblock').length")) > 20:
                break
        assert shown > 20
        others = "performance.getEntriesByType('resource').filter(e => !e.name.startsWith(location.origin)).length"
        assert browser.evaluate(others) == 0
        inline = "(() => { const s = document.createElement('script'); s.text = 'window.evil = 1';"
        assert browser.evaluate(f"{inline} document.body.append(s); return window.evil === 1; }})()") is False
