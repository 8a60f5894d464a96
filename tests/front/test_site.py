"""`make docs`: every page is there, no link leads nowhere, it asks nothing of other machines, and the search finds."""

import http.server
import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from tests.browser import CHROMIUM, Page

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(words, check=False, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_in_the_menu(site: Path) -> None:
    start = (site / "index.html").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert (site / f"{page.stem}.html").exists()
        assert f'href="{page.stem}.html"' in start, f"{page.name} is a row of mkdocs.yml's nav"
    assert (site / "results" / "ground" / "curves.png").exists()


def test_the_search_finds_and_nothing_is_asked_of_others(site: Path, tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the site was not searched")
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(site))
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, Page(tmp_path) as page:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_address[1]}/"
        page.open(address + "index.html?q=committed+plan")
        page.until("document.querySelectorAll('.md-search-result__item').length > 0")
        found = page.value("document.querySelector('.md-search-result__list').textContent")
        assert "Glossary" in found
        assert [url for url in page.requests if not url.startswith((address, "data:", "blob:"))] == []
        server.shutdown()
