"""The report looks like its stored screenshots: on a phone and on a desktop, light and dark, and in print.

Of each section a small picture is kept, averaged so much that a browser's next version changes little, and what is
gone, doubled or in another colour changes much. They are of one font, which has to be there. After a
change that is meant, run `BRAKELINE_PICTURES=write pytest tests/logs/test_report_screenshots.py`
and look at what it wrote.
"""

import base64
import io
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.browser import Page

FONT = "DejaVu Sans"  # the one that Debian's fontconfig comes with
STORED = Path(__file__).parent.parent / "truth" / "pictures"
EDGE = 64  # px of a section's small picture
MEAN, TILE = 3.0, 24.0  # of 255: how far apart two pictures, and one of its 8 by 8 tiles, may be on average
TALLER = 0.12  # of a section's height
LAYOUTS = {f"{width}-{scheme}": (width, "screen", scheme) for width in (390, 1400) for scheme in ("light", "dark")} | {
    "print": (680, "print", "light")
}


def installed(font: str) -> bool:
    try:
        return bool(subprocess.run(["fc-list", font], capture_output=True, check=True).stdout)
    except (OSError, subprocess.CalledProcessError):
        return False


def sections(page: Page) -> tuple[np.ndarray, np.ndarray]:
    """Return small pictures (n, EDGE, EDGE, 3) of the page's sections, and the sections' heights [px]."""
    places = page.value(
        "[...document.querySelectorAll('section')].map(s => s.getBoundingClientRect())"
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
    picture = np.asarray(Image.open(STORED / f"report-{name}.png").convert("RGB"), dtype=float)
    heights = np.loadtxt(STORED / f"report-{name}.txt", ndmin=1)
    return picture.reshape(-1, EDGE, EDGE, 3), heights


@pytest.mark.skipif(not installed(FONT), reason=f"no {FONT}: the report was not compared with its pictures")
@pytest.mark.parametrize("name", LAYOUTS)
def test_the_report_looks_like_the_stored_screenshots(page: Page, name: str) -> None:
    width, medium, scheme = LAYOUTS[name]
    page.size(width, 900)
    page.media(medium, scheme)
    page.value(f"document.body.style.fontFamily = '{FONT}'")
    try:
        now, heights = sections(page)
        page.value("[...document.querySelectorAll('.charts')].forEach(c => c.style.visibility = 'hidden')")
        bare, _ = sections(page)
    finally:
        page.value("document.body.style.fontFamily = ''")
        page.value("[...document.querySelectorAll('.charts')].forEach(c => c.style.visibility = '')")
        page.media()
        page.size(1280, 900)
    if os.environ.get("BRAKELINE_PICTURES") == "write":
        STORED.mkdir(parents=True, exist_ok=True)
        Image.fromarray(now.reshape(-1, EDGE, 3).astype(np.uint8)).save(STORED / f"report-{name}.png")
        np.savetxt(STORED / f"report-{name}.txt", heights, fmt="%.0f")
    before, tall = stored(name)
    assert len(now) == len(before), "a section is gone, or new"
    assert (np.abs(heights - tall) <= TALLER * tall).all(), (heights, tall)
    mean, tile = apart(now, before)
    assert (mean <= MEAN).all() and (tile <= TILE).all(), (mean.round(1), tile.round(1))
    mean, tile = apart(bare, before)
    assert (mean > MEAN).any() or (tile > TILE).any(), "without its charts it would not be told from what is stored"
