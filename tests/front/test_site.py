"""`make docs`: every page is there, no link leads nowhere, it asks nothing of other machines, and the search finds."""

import http.server
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from brakeline.deploy.cli import COMMANDS
from tests.browser import Page

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


def test_the_start_page_shows_what_the_readme_shows(site: Path) -> None:
    start = (site / "index.html").read_text()
    assert "Three uses" in start and "quadrotor, after 120,000 steps" in start
    assert "data:image/png;base64" in (site / "a_decision.html").read_text(), "the notebook has its picture"
    assert "<!-- README" not in start and 'href="results_scans.html"' in start


def test_the_reference_shows_docstrings_and_help(site: Path) -> None:
    python, line = (site / "api.html").read_text(), (site / "cli.html").read_text()
    assert "Request the decision on an action and commit to its plan." in python, "the protocol of the clients"
    assert '<span class="gp">' in python, "examples are code"
    for command, entry in COMMANDS.items():
        assert f'id="{command}"' in line and f"usage: brakeline {command} " in line and entry.summary in line, command


@pytest.fixture
def page(browser: Page) -> Page:
    """The browser, which has asked for nothing and has not complained yet."""
    browser.requests.clear()
    browser.complaints.clear()
    return browser


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[str]:
    """The address of the site."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(site))
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


def asked_elsewhere(page: Page, address: str) -> list[str]:
    return [url for url in page.requests if not url.startswith((address, "data:", "blob:"))]


@pytest.mark.parametrize("opened_as", ["file", "served"])
def test_the_search_finds_and_nothing_is_asked_of_others(
    page: Page, site: Path, request: pytest.FixtureRequest, opened_as: str
) -> None:
    address = f"{site.as_uri()}/" if opened_as == "file" else request.getfixturevalue("served")
    page.open(f"{address}index.html?q=committed+plan")
    page.until("document.querySelectorAll('.md-search-result__item').length > 0")
    assert "Glossary" in page.value("document.querySelector('.md-search-result__list').textContent")
    assert asked_elsewhere(page, address) == []


def test_every_command_of_the_tutorial_can_be_copied(page: Page, served: str) -> None:
    page.open(served + "tutorial_4_policy.html")
    page.until("document.querySelectorAll('.md-clipboard, .md-code__button').length > 0")
    blocks = page.value("document.querySelectorAll('article pre').length")
    assert page.value("document.querySelectorAll('.md-clipboard, .md-code__button').length") == blocks
    assert page.value("document.querySelectorAll('article pre .k').length") > 0, "Python is highlighted"


def test_formulas_and_figures_are_drawn_and_nothing_is_asked_of_others(page: Page, served: str) -> None:
    page.open(served + "method.html")
    formulas = page.value("document.querySelectorAll('.arithmatex').length")
    assert formulas > 50
    page.until(f"document.querySelectorAll('.arithmatex .katex').length == {formulas}")
    assert page.value("document.querySelectorAll('.katex-error').length") == 0
    assert page.value("[...document.querySelectorAll('article img')].filter(i => !i.naturalWidth).length") == 0
    assert page.complaints == []
    assert asked_elsewhere(page, served) == []
