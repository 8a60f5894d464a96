"""Report and live page look like their stored screenshots: on a phone and on a desktop, light and dark, and in print.

Of each part a small picture is kept, averaged so much that a browser's next version changes little, and what is
gone, doubled or in another colour changes much. They are of one font, which has to be there. After a
change that is meant, run `BRAKELINE_PICTURES=write pytest tests/logs/test_report_screenshots.py`
and look at what it wrote.
"""

import base64
import io
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from brakeline.logs.log_analysis import analyse_runs
from brakeline.logs.report_page import write
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.live_page_server import LivePageServer
from brakeline.messaging.bus import Sample
from brakeline.messaging.topics import TOPICS
from tests.browser import CHROMIUM, Page, drawn
from tests.logs.sample_log import ABOUT, Writer, mixed

FONT = "DejaVu Sans"  # the one that Debian's fontconfig comes with
STORED = Path(__file__).parent.parent / "truth" / "pictures"
EDGE = 64  # px of a section's small picture
MEAN, TILE = 3.0, 24.0  # of 255: how far apart two pictures, and one of its 8 by 8 tiles, may be on average
TALLER = 0.12  # of a section's height
LAYOUTS = {f"{width}-{scheme}": (width, "screen", scheme) for width in (390, 1400) for scheme in ("light", "dark")} | {
    "print": (680, "print", "light")
}
# Resolves when no canvas has been drawn again for some frames of the browser.
STILL = """new Promise(done => { let last = '', same = 0; const look = () => {
    const frames = [...document.querySelectorAll('canvas')].map(c => c.dataset.frames).join();
    [same, last] = [frames === last ? same + 1 : 0, frames];
    if (same > 5) done(true); else requestAnimationFrame(look); }; look(); })"""
FEW = ("390-dark", "1400-light", "print")


def installed(font: str) -> bool:
    try:
        return bool(subprocess.run(["fc-list", font], capture_output=True, check=True).stdout)
    except (OSError, subprocess.CalledProcessError):
        return False


needs_font = pytest.mark.skipif(not installed(FONT), reason=f"no {FONT}: the pages were not compared with pictures")


def sections(page: Page, selector: str) -> tuple[np.ndarray, np.ndarray]:
    """Return small pictures (n, EDGE, EDGE, 3) of parts of the page, and the parts' heights [px]."""
    places = page.value(
        f"[...document.querySelectorAll('{selector}')].map(s => s.getBoundingClientRect())"
        ".filter(r => r.height > 0).map(r => [r.x + scrollX, r.y + scrollY, r.width, r.height])"
    )
    tiles = []
    for x, y, width, height in places:
        clip = {"x": x, "y": y, "width": width, "height": height, "scale": 0.5}
        shot = page.call("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)["data"]
        image = Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")
        tiles.append(np.asarray(image.resize((EDGE, EDGE), Image.Resampling.BOX), dtype=float))
    return np.array(tiles), np.array([place[3] for place in places])


def apart(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean difference and the largest difference of a tile, (n,) each."""
    tiles = np.abs(one - other).reshape(len(one), EDGE // 8, 8, EDGE // 8, 8, 3).mean(axis=(2, 4, 5))
    return tiles.mean(axis=(1, 2)), tiles.max(axis=(1, 2))


def stored(name: str) -> tuple[np.ndarray, np.ndarray]:
    picture = np.asarray(Image.open(STORED / f"{name}.png").convert("RGB"), dtype=float)
    heights = np.loadtxt(STORED / f"{name}.txt", ndmin=1)
    return picture.reshape(-1, EDGE, EDGE, 3), heights


def compare(page: Page, what: str, name: str, selector: str, essential: str) -> None:
    """Compare parts of the page with their stored pictures; without what is `essential` they must differ."""
    width, medium, scheme = LAYOUTS[name]
    page.size(width, 900)
    page.media(medium, scheme)
    page.value(f"document.body.style.fontFamily = '{FONT}'")
    page.until(f"innerWidth === {width}")
    page.value(STILL)
    hide = f"[...document.querySelectorAll('{essential}')].forEach(part => part.style.visibility = '{{}}')"
    try:
        now, heights = sections(page, selector)
        page.value(hide.format("hidden"))
        bare, _ = sections(page, selector)
    finally:
        page.value("document.body.style.fontFamily = ''")
        page.value(hide.format(""))
        page.media()
        page.size(1280, 900)
    if os.environ.get("BRAKELINE_PICTURES") == "write":
        STORED.mkdir(parents=True, exist_ok=True)
        Image.fromarray(now.reshape(-1, EDGE, 3).astype(np.uint8)).save(STORED / f"{what}-{name}.png")
        np.savetxt(STORED / f"{what}-{name}.txt", heights, fmt="%.0f")
    before, tall = stored(f"{what}-{name}")
    assert len(now) == len(before), "a part is gone, or new"
    assert (np.abs(heights - tall) <= TALLER * tall).all(), (heights, tall)
    mean, tile = apart(now, before)
    assert (mean <= MEAN).all() and (tile <= TILE).all(), (mean.round(1), tile.round(1))
    mean, tile = apart(bare, before)
    assert (mean > MEAN).any() or (tile > TILE).any(), f"without {essential} it would not be told from what is stored"


@needs_font
@pytest.mark.parametrize("name", LAYOUTS)
def test_the_report_looks_like_the_stored_screenshots(page: Page, name: str) -> None:
    compare(page, "report", name, "section", ".charts")


@needs_font
@pytest.mark.parametrize("name", FEW)
def test_a_flight_looks_like_the_stored_screenshots(page: Page, name: str) -> None:
    page.value("(p => p.show(p.all.findIndex(i => i.robot === 'quadrotor' && !i.episode.at)))(pickers.get(0))")
    compare(page, "flight", name, "#picker .stage, #picker .plots", ".stage canvas")


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The live page of a run of a ground robot and a quadrotor, each in the middle of an episode."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the live page was not looked at")
    writer, board = Writer(seed=2, losses=0.0), Dashboard()
    for number in range(8):
        writer.episode("actor-0", number)
        writer.episode("drone-0", number, robot="quadrotor")
    for entry in writer.entries:
        topic = next(topic for topic in TOPICS if entry.type is topic.message)
        board.add(Sample(topic, entry.key, entry.payload, entry.log_time))
    folder = tmp_path_factory.mktemp("live")
    with LivePageServer(board.view) as server, Page(folder) as page:
        page.size(1400, 2400)
        page.open(server.url)
        frames = "[...document.querySelectorAll('.stage canvas')].map(c => Number(c.dataset.frames ?? 0))"
        page.until(f"{frames}.length === 2 && {frames}.every(n => n > 0)")
        page.value("events.close()")  # the time since the last message would go on, and move what is below it
        yield page


@needs_font
@pytest.mark.parametrize("name", FEW)
def test_the_live_page_looks_like_the_stored_screenshots(live: Page, name: str) -> None:
    compare(live, "live", name, ".card .stage, .card .beside, .below .wide", ".stage canvas")
    assert live.complaints == []


@pytest.fixture(scope="module")
def methods(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The report of four methods with three seeds each."""
    folder = tmp_path_factory.mktemp("methods")
    with pytest.MonkeyPatch.context() as patch:
        for number, method in enumerate(("ddpc", "sailr", "secas", "none")):
            for seed in range(3):
                patch.setitem(ABOUT, "run", ABOUT["run"] | {"method": method, "seed": str(seed)})
                mixed(folder / f"{method}-{seed}", 3 * number + seed, 6, later=1e4 * (3 * number + seed))
    analysis = analyse_runs(sorted(folder.iterdir()))  # the parts of single runs are not compared
    write(folder / "page.html", analysis.figures(), analysis.by_label())
    with drawn(folder / "page.html", tmp_path_factory.mktemp("browser")) as page:
        yield page


@needs_font
@pytest.mark.parametrize("name", FEW)
def test_four_methods_with_three_seeds_look_like_the_stored_screenshots(methods: Page, name: str) -> None:
    compare(methods, "methods", name, "#comparison, #groups, #learning-section", ".charts")
    assert methods.complaints == []
