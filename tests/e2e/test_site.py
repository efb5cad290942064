"""The site of the documentation: strictly built, complete, without other hosts, searched without a server."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import splatbot
from tests.browser.chromium import Chromium

ROOT = Path(__file__).parents[2]
LOADED = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src"}

pytestmark = pytest.mark.long


class Addresses(HTMLParser):
    """Addresses that a page loads, and addresses that it links."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the addresses of one tag."""
        values = dict(attrs)
        self.loaded += filter(None, [values.get(LOADED.get(tag, ""))])
        self.linked += filter(None, [values.get("href") if tag == "a" else None])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; the build fails at each warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "docs/site/mkdocs.yml", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def reached(start: Path) -> set[Path]:
    """Return the pages to which links lead from ``start``."""
    found, waiting = {start}, [start]
    while waiting:
        page = waiting.pop()
        links = (urlsplit(link) for link in Addresses(page).linked)
        targets = {(page.parent / unquote(link.path)).resolve() for link in links if not link.scheme and link.path}
        new = {target for target in targets if target.suffix == ".html"} - found
        found |= new
        waiting += new
    return found


def test_no_page_loads_a_file_of_another_host(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    loaded = [address for page in pages for address in Addresses(page).loaded]
    assert len(pages) > 80
    assert len(loaded) > 5 * len(pages)
    assert [address for address in loaded if urlsplit(address).netloc or urlsplit(address).scheme] == []


def test_links_lead_from_the_first_page_to_every_document(site: Path) -> None:
    documents = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    pages = {
        site / (path.with_name("index.html") if path.name == "README.md" else path.with_suffix(".html"))
        for path in documents
    }
    assert pages - reached(site / "index.html") == set()


def test_the_reference_documents_and_links_every_public_name(site: Path) -> None:
    reference = site / "reference"
    text = "".join(page.read_text(encoding="utf-8") for page in reference.glob("splatbot.*.html"))
    documented = {identifier.rsplit(".", 1)[1] for identifier in re.findall(r'id="(splatbot\.[\w.]+)"', text)}
    listed = set(re.findall(r"#splatbot\.[\w.]*?(\w+)\"", (reference / "index.html").read_text(encoding="utf-8")))
    assert set(splatbot.__all__) <= listed
    for name in ("logs", "rasterize", "collision", "planning", "segmentation", "evaluation", "gaussians"):
        exported = importlib.import_module(f"splatbot.{name}").__all__
        assert set(exported) - documented <= {"Goal"}  # an alias of a type, without a docstring


@pytest.mark.alone
def test_search_finds_a_guide_in_pages_opened_as_files(site: Path, tmp_path: Path) -> None:
    found: list[str] = []
    with Chromium(tmp_path, flags=("--host-resolver-rules=MAP * ~NOTFOUND",)) as browser:
        browser.open(f"{site.as_uri()}/index.html?q=emergency+stop")
        for _ in range(200):
            time.sleep(0.1)
            found = browser.evaluate("[...document.querySelectorAll('.md-search-result__link')].map(a => a.href)")
            if found:
                break
        requests = browser.evaluate("performance.getEntriesByType('resource').map(entry => entry.name)")
    assert any("/guide/" in address for address in found)
    assert all(request.startswith("file:") for request in requests)
