"""The report in a real browser: it draws without a complaint and without a request, and says what `--json` says."""

import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from deploy.cli import main
from logs.analysis import Look, analysed
from logs.page import embedded, names, number, percent, render
from tests.browser import CHROMIUM, Page
from tests.logs.mixed import mixed

TRICKS = "</script><script>alert(1)</script><!-- \u2028"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The page of a log, and the figures that `analyse --json` gives for it."""
    folder = tmp_path_factory.mktemp("page")
    log = mixed(folder / "<b>mixed")
    analysis = analysed(log, Look(pictures=True))
    path = folder / "report.html"
    path.write_text(render(analysis.figures(), analysis.pictures()), encoding="utf-8")
    return path, json.loads(json.dumps(analysis.figures()))


@pytest.fixture(scope="module")
def page(report: tuple[Path, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the report was not driven in a browser")
    with Page(tmp_path_factory.mktemp("browser")) as page:
        page.open(report[0].as_uri())
        page.until("document.documentElement.dataset.drawn === 'yes'")
        yield page


class Cells(HTMLParser):
    """What stands in the elements that show a figure, by its name."""

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, Any] = {}

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        if "data-figure" in found:
            self.values[str(found["data-figure"])] = json.loads(str(found["data-value"]))


def looked_up(figures: dict[str, Any], name: str) -> Any:
    """The figure of a dotted name; keys may have dots and slashes themselves."""
    if name in figures:
        return figures[name]
    for key in figures:
        if name.startswith(f"{key}.") and isinstance(figures[key], dict):
            return looked_up(figures[key], name[len(key) + 1 :])
    raise KeyError(name)


def test_the_tables_say_what_json_says_without_a_script(report: tuple[Path, dict[str, Any]]) -> None:
    path, figures = report
    cells = Cells()
    cells.feed(path.read_text())
    counts = {"violations.count": ("containment", "violations"), "violations.of": ("containment", "steps")}
    for name, value in cells.values.items():
        if name in counts:
            group, field = counts[name]
            assert value == figures[group][field]
        elif name.endswith((".count", ".of")) and name.count(".") == 1:
            assert (
                value == figures[name.split(".")[0] if name.endswith("count") else "steps"]
                or value == figures["episodes"]
            )
        else:
            assert value == looked_up(figures, name), name
    assert {"goals", "collisions", "closest_approach", "intervals.goals", "latency_ms.adjusted.solve.p99"} <= set(
        cells.values
    )
    assert sum(name.startswith("topics.") for name in cells.values) == 3 * len(figures["topics"])


def test_it_needs_no_network_and_no_other_file(report: tuple[Path, dict[str, Any]]) -> None:
    text = report[0].read_text()
    assert "default-src 'none'" in text
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", text)
    addresses = set(re.findall(r"https?://[^\s\"'<]+", text))
    assert addresses <= {"http://www.w3.org/2000/svg"}, "a name, not an address that is asked"
    assert len(text) < 3_000_000


def test_it_loads_without_a_complaint_or_a_request(page: Page, report: tuple[Path, dict[str, Any]]) -> None:
    assert page.complaints == []
    assert [url for url in page.requests if not url.startswith(("file:", "data:"))] == []
    assert page.value("document.title") == "Brakeline: <b>mixed"
    assert page.value("document.querySelectorAll('h1 b').length") == 0, "names are text, whatever is in them"


def test_everything_is_drawn(page: Page, report: tuple[Path, dict[str, Any]]) -> None:
    figures = report[1]
    drawn = page.value("""({
        rates: document.querySelectorAll('#rates .whisker svg').length,
        curves: [...document.querySelectorAll('#learning svg')].map(s => s.getAttribute('aria-label')),
        maps: document.querySelectorAll('#places svg rect').length,
        near: document.querySelectorAll('#near .card svg').length,
        tubes: document.querySelectorAll('#near .card svg rect[stroke="#7a4fc0"]').length,
        bars: document.querySelectorAll('#latency svg rect').length,
        lanes: [...document.querySelectorAll('#timeline svg text')].map(t => t.textContent),
        broken: [...document.querySelectorAll('svg, #picker, .card')].map(e => e.outerHTML).join()
            .match(/NaN|undefined|Infinity/g),
    })""")
    assert drawn["rates"] == 5 and drawn["near"] == 16 and drawn["tubes"] > 20 and drawn["bars"] > 20
    assert len(drawn["curves"]) == 8 and "goals reached" in drawn["curves"], "four for each robot kind"
    assert drawn["maps"] > 50 and set(figures["processes"]) <= set(drawn["lanes"])
    assert drawn["broken"] is None


def test_parts_of_the_latency_are_chosen(page: Page) -> None:
    for part in ("solve", "network", "round_trip"):
        page.value(f"document.querySelector('#latency button[data-part={part}]').click()")
        assert page.value("document.querySelector('#latency svg').dataset.part") == part
    assert page.complaints == []


def test_the_picker_shows_the_episode_that_was_picked(page: Page, report: tuple[Path, dict[str, Any]]) -> None:
    data = page.value("data.galleries")
    every = [episode for gallery in data.values() for episode in gallery["episodes"]]
    assert page.value("document.querySelectorAll('#picker option').length") == len(every) > 10

    def facts() -> dict[str, str]:
        pairs = "[...document.querySelectorAll('#episode-facts dd')].map(d => [d.dataset.fact, d.textContent])"
        found: dict[str, str] = page.value(f"Object.fromEntries({pairs})")
        return found

    for place in (0, len(every) - 1, 3):
        choose = f"s.value = {place}; s.dispatchEvent(new Event('change'))"
        page.value(f"(() => {{ const s = document.querySelector('#picker select'); {choose} }})()")
        said, episode = facts(), every[place]
        assert (said["actor"], said["episode"], said["outcome"]) == (
            episode["actor"], str(episode["episode"]), episode["outcome"]
        )  # fmt: skip
        assert said["steps"] == str(episode["steps"]) and said["step"] == str(episode["first"] + episode["closest_at"])
    slide = "r.value = 1; r.dispatchEvent(new Event('input'))"
    page.value(f"(() => {{ const r = document.querySelector('#picker input'); {slide} }})()")
    assert facts()["step"] == str(every[3]["first"] + 1)
    page.value("document.querySelector('#picker button[aria-label=\"next episode\"]').click()")
    assert facts()["episode"] == str(every[4]["episode"])
    page.value("document.querySelectorAll('#near .card button')[2].click()")
    order = data["ground"]["near"][2]
    near = next(episode for episode in data["ground"]["episodes"] if episode["order"] == order)
    assert (facts()["actor"], facts()["episode"]) == (near["actor"], str(near["episode"]))
    page.value("document.querySelector('#picker button:not([aria-label])').click()")
    page.until("document.querySelector('#picker button:not([aria-label])').textContent === 'play'")
    assert page.complaints == []


def test_an_empty_log_has_a_page_too(tmp_path: Path, report: tuple[Path, dict[str, Any]]) -> None:
    from logs.segment import open_segment

    open_segment(tmp_path / "run.mcap", {"run": {"method": TRICKS}, "odd": {TRICKS: TRICKS}}).finish()
    assert main(["analyse", str(tmp_path / "run.mcap"), "--html", str(tmp_path / "a" / "page.html"), "--json"]) == 0
    text = (tmp_path / "a" / "page.html").read_text()
    assert "alert(1)</script>" not in text
    if CHROMIUM is not None:
        with Page(tmp_path / "browser") as page:
            page.open((tmp_path / "a" / "page.html").as_uri())
            page.until("document.documentElement.dataset.drawn === 'yes'")
            assert page.complaints == []
            assert page.value("document.querySelectorAll('.none').length") == 6


def test_numbers_are_for_people() -> None:
    assert [number(value) for value in (None, 0, 1234567, 0.123456, 12.0)] == [
        "–",
        "0",
        "1\u202f234\u202f567",
        "0.123",
        "12",
    ]
    assert [percent(value) for value in (None, 0.0, 0.5, 0.00123)] == ["–", "0.0 %", "50.0 %", "0.12 %"]
    assert json.loads(embedded({"x": TRICKS, "y": float("nan")})) == {"x": TRICKS, "y": None}
    assert "<" not in embedded(TRICKS)


def test_what_a_page_is_made_of_is_packaged() -> None:
    folder = Path(__file__).parents[2] / "logs" / "page"
    assert {item.name for item in folder.iterdir() if item.suffix in (".j2", ".css", ".js")} == set(names())


HOSTILE = '"><img src=x onerror="document.title=\'owned\'"></title></text><script>document.title="owned"</script>'


def hostile(folder: Path) -> Path:
    """A page of figures in which every text that a log can choose is a script."""

    analysis = analysed(mixed(folder / "log"), Look(pictures=True))
    figures, pictures = (json.loads(json.dumps(part)) for part in (analysis.figures(), analysis.pictures()))
    figures["processes"] |= {HOSTILE: next(iter(figures["processes"].values()))}
    figures["topics"] |= {HOSTILE: {"messages": 1, "missing": 1, "duplicates": 1}}
    figures["training"] = {HOSTILE: next(iter(figures["training"].values()))} | figures["training"]
    timeline = pictures["timeline"]
    timeline["lives"] += [life | {"process": HOSTILE} for life in timeline["lives"]]
    timeline["lines"].append({"t": 0.0, "process": HOSTILE, "level": HOSTILE, "text": HOSTILE})
    pictures["places"] = {HOSTILE: next(iter(pictures["places"].values()))} | pictures["places"]
    for gallery in pictures["galleries"].values():
        for episode in gallery["episodes"]:
            episode |= {"actor": HOSTILE, "robot": HOSTILE, "arena": HOSTILE, "outcome": HOSTILE}
            for tube in episode["tubes"].values():
                tube["reason"] = HOSTILE
    path = folder / "hostile.html"
    path.write_text(render(figures, pictures), encoding="utf-8")
    return path


def test_no_name_in_a_log_is_a_script_of_the_page(tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the report was not driven in a browser")
    path = hostile(tmp_path)
    bare = tmp_path / "bare.html"  # without its policy: the escaping alone must do
    bare.write_text(re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", path.read_text()))
    with Page(tmp_path / "browser") as page:
        for place in (bare, path):
            page.open(place.as_uri())
            page.until("document.documentElement.dataset.drawn === 'yes'")
            assert page.value("document.querySelectorAll('img, svg script, main script').length") == 0
            assert page.value("document.title").startswith("Brakeline: ")
        assert page.complaints == []


def test_its_policy_lets_no_script_or_style_run_but_its_own(
    report: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    policy = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', report[0].read_text())
    assert len(policy) == 1 and "unsafe" not in policy[0] and policy[0].count("'sha256-") == 2
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the report was not driven in a browser")
    injected = tmp_path / "injected.html"
    tricks = "<script>document.title = 'owned'</script><img src='data:,' onerror=\"document.title = 'owned'\">"
    injected.write_text(report[0].read_text().replace("<main>", f"<main>{tricks}", 1))
    with Page(tmp_path / "browser") as page:
        page.open(injected.as_uri())
        page.until("document.documentElement.dataset.drawn === 'yes'")
        assert page.value("document.title").startswith("Brakeline: ")
        assert any("Content Security Policy" in complaint for complaint in page.complaints)
