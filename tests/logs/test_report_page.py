"""The report in a real browser: it draws without errors or requests, with the values of `--json`, and saves figures."""

import csv
import io
import json
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from brakeline.deploy.cli import main
from brakeline.logs.log_analysis import AnalysisOptions, LogAnalysis, analyse_runs
from brakeline.logs.report_page import embedded, number, percent, render, write
from brakeline.logs.segment import open_segment
from tests.browser import Page, drawn
from tests.full_disk import full_disk
from tests.logs.sample_log import ABOUT, mixed

Report = tuple[Path, dict[str, Any]]
Compared = tuple[Path, list[dict[str, Any]]]
TRICKS = "</script><script>alert(1)</script><!-- \u2028"


def flattened(figures: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield figures by their dotted names."""
    for name, value in figures.items():
        yield prefix + name, value
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{name}.")


def test_the_tables_have_the_values_of_json_without_a_script(report: Report) -> None:
    path, figures = report
    shown = re.findall(r'data-figure="([^"]*)"\s+data-value="([^"]*)"', path.read_text())
    values = {unescape(name): json.loads(unescape(value)) for name, value in shown}
    flat = dict(flattened(figures))
    containment = {"violations.count": "violations", "violations.of": "steps"}
    for name, value in values.items():
        rate, _, part = name.partition(".")
        if name in containment:
            assert value == figures["containment"][containment[name]]
        elif part == "of":
            assert value in (figures["steps"], figures["episodes"]), name
        else:
            assert value == flat[rate if part == "count" else name], name
    wanted = {"goals", "collisions", "closest_approach", "intervals.goals", "latency_ms.adjusted.solve.p99"}
    assert wanted <= values.keys()
    assert sum(name.startswith("topics.") for name in values) == 3 * len(figures["topics"])


def test_it_says_in_words_how_sure_a_model_set_is(analysis: LogAnalysis) -> None:
    [(label, (figures, pictures))] = analysis.by_label().items()

    def said(**more: str) -> str:
        metadata = {"model ground": {"version": "abc", "bound_step": "0.003", **more}}
        return " ".join(render(analysis.figures(), {label: (figures | {"metadata": metadata}, pictures)}).split())

    thousands = number(figures["steps"]).replace("\u202f", " ")  # as `split` leaves them
    steps = f"Over the {thousands} steps of this run that adds up to at most"
    before = said()
    assert "at 99 % confidence, that at most 0.3 % of the steps leave their predicted set. Over the" in before
    assert f"{steps} {number(0.003 * figures['steps'])} steps outside on average." in before
    whole = said(bound_plan="0.02", windows="300", bound_episode="0.594", outside_hour="54")
    assert "from 300 held-out plans, that" in whole
    assert "and at most 2 % of the plans their tube, driven to the stop." in whole
    assert "over an hour of driving to 54, over an episode of 300 steps to at least one with a probability of" in whole
    assert "up to 60 %, if steps are independent." in whole


def test_it_has_what_was_driven_by_kind_beside_what_is_stated(analysis: LogAnalysis) -> None:
    [(label, (figures, pictures))] = analysis.by_label().items()
    kinds = {
        "standing": {"windows": 7, "outside": 2, "excess": 1.5, "bound": 0.0125},
        "fast": {"windows": 5000, "outside": 0, "excess": 0.9, "bound": None},
        "jumping <inputs>": {"windows": 1, "outside": 1, "excess": float("inf"), "bound": 1.0},
    }
    page = render(analysis.figures(), {label: (figures | {"driving": {"ground": kinds}}, pictures)})
    table = re.search(r"<table[^>]*><thead><tr><th>driving of ground</th>.*?</table>", page, re.DOTALL)
    assert table is not None
    head, *rows = re.findall(r"<tr>(.*?)</tr>", table[0], re.DOTALL)
    texts = [[unescape(cell) for cell in re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row)] for row in (head, *rows)]
    assert texts == [
        ["driving of ground", "windows", "outside the stated sets", "share", "stated, of plans"],
        ["standing", "7", "2", "28.6 %", "≤ 1.3 %"],
        ["fast", "5\u202f000", "0", "0.0 %", "–"],
        ["jumping <inputs>", "1", "1", "100.0 %", "≤ 100 %"],
    ]
    values = dict(re.findall(r'data-figure="driving\.ground\.([^"]*)"\s+data-value="([^"]*)"', table[0]))
    assert {unescape(name): json.loads(value) for name, value in values.items()} == {
        f"{kind}.{name}": row[name] for kind, row in kinds.items() for name in ("windows", "outside", "bound")
    }


def test_it_needs_no_network_and_no_other_file(report: Report) -> None:
    text = report[0].read_text()
    assert "default-src 'none'" in text
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", text)
    addresses = set(re.findall(r"https?://[^\s\"'<]+", text))
    names = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml"}
    assert addresses <= names, "names, not addresses that are asked"
    assert len(text) < 3_000_000


def test_it_loads_without_a_complaint_or_a_request(page: Page) -> None:
    assert page.complaints == []
    assert [url for url in page.requests if not url.startswith(("file:", "data:"))] == []
    assert page.value("document.title") == "Brakeline: <b>mixed"
    assert page.value("document.querySelectorAll('h1 b').length") == 0, "names are text, whatever is in them"


def test_a_decision_is_explained_by_a_sentence_arrows_and_an_edge(page: Page) -> None:
    shown = page.value("""({
        words: [...document.querySelectorAll('#near .why')].map(p => p.textContent),
        proposed: document.querySelectorAll('#near path.proposed').length,
        executed: document.querySelectorAll('#near path.executed').length,
        edges: document.querySelectorAll('#near line.edge').length,
        legend: document.querySelector('#picker').textContent,
    })""")
    stepped_in = [words for words in shown["words"] if "too close to the box" in words]
    assert stepped_in and all("it (after 0.2 s) would have come 3 cm too close" in words for words in stepped_in)
    assert any("speed 0.2 → 0.1 m/s, turn rate 0.2 → 0.1 rad/s" in words for words in shown["words"])
    assert shown["proposed"] == shown["executed"] > 0 and shown["edges"] > 0
    assert "→ proposed" in shown["legend"] and "half-space that blocks the proposal" in shown["legend"]


def test_everything_is_drawn(page: Page, report: Report) -> None:
    figures = report[1]
    drawn = page.value("""({
        rates: document.querySelectorAll('#rates .whisker svg').length,
        curves: [...document.querySelectorAll('#learning svg')].map(s => s.getAttribute('aria-label')),
        maps: document.querySelectorAll('#places svg rect').length,
        near: document.querySelectorAll('#near .card svg').length,
        tubes: document.querySelectorAll('#near .card svg rect.tube').length,
        bars: document.querySelectorAll('#latency svg rect').length,
        lanes: [...document.querySelectorAll('#timeline svg text')].map(t => t.textContent),
        broken: [...document.querySelectorAll('svg, #picker, .card')].map(e => e.outerHTML).join()
            .match(/NaN|undefined|Infinity/g),
    })""")
    assert drawn["rates"] == 8 and drawn["near"] == 16 and drawn["tubes"] > 20 and drawn["bars"] > 20
    assert len(drawn["curves"]) == 10 and "goals reached" in drawn["curves"], "of both robot kinds"
    assert drawn["maps"] > 20 and set(figures["processes"]) <= set(drawn["lanes"])
    assert drawn["broken"] is None


def test_parts_of_the_latency_are_chosen(page: Page) -> None:
    for part in ("solve", "network", "round_trip"):
        page.value(f"document.querySelector('#latency button[data-part={part}]').click()")
        assert page.value("document.querySelector('#latency svg').dataset.part") == part
    assert page.complaints == []


def facts_of(page: Page) -> dict[str, str]:
    """Return what the picker says of the episode and step that it shows."""
    pairs = "[...document.querySelectorAll('#episode-facts dd')].map(d => [d.dataset.fact, d.textContent])"
    facts: dict[str, str] = page.value(f"Object.fromEntries({pairs})")
    return facts


def test_the_picker_shows_the_episode_that_was_picked(page: Page) -> None:
    closest = page.value("[...document.querySelectorAll('#near .card')].map(c => Number(c.dataset.closest))")
    assert closest == sorted(closest), "worst first, of all robots"
    data = page.value("data[0].galleries")
    galleries = [gallery["episodes"] + gallery["rest"] for gallery in data.values()]
    every = [episode for gallery in galleries for episode in sorted(gallery, key=lambda one: int(one["order"]))]
    assert page.value("document.querySelectorAll('#picker option').length") == len(every) > 10
    assert len(every) == sum(gallery["total"] for gallery in data.values()), "every episode is reachable"

    for place in (0, len(every) - 1, 3):
        choose = f"s.value = {place}; s.dispatchEvent(new Event('change'))"
        page.value(f"(() => {{ const s = document.querySelector('#picker select'); {choose} }})()")
        said, episode = facts_of(page), every[place]
        for name in ("actor", "episode", "outcome"):
            assert said[name] == str(episode[name])
        assert said["steps"] == str(episode["steps"]) and said["step"] == str(episode["first"] + episode["closest_at"])
    slide = "r.value = 1; r.dispatchEvent(new Event('input'))"
    page.value(f"(() => {{ const r = document.querySelector('#picker input'); {slide} }})()")
    assert facts_of(page)["step"] == str(every[3]["first"] + every[3].get("at", [0, 1])[1])
    page.value("document.querySelector('#picker button[aria-label=\"next episode\"]').click()")
    assert facts_of(page)["episode"] == str(every[4]["episode"])
    page.value("document.querySelectorAll('#near .card button')[2].click()")
    orders = [(robot, order) for robot in data for order in data[robot]["near"]]
    missed = [next(e for e in data[robot]["episodes"] if e["order"] == order) for robot, order in orders]
    near = sorted(missed, key=lambda episode: episode["closest"])[2]
    assert (facts_of(page)["actor"], facts_of(page)["episode"]) == (near["actor"], str(near["episode"]))
    page.value("document.querySelector('#picker .play').click()")
    page.until("document.querySelector('#picker .play').textContent === 'play'")
    assert page.complaints == []


SAVE = "window.save = (name, kind, text) => { window.saved = { name, kind, text }; }"


def test_figures_and_their_data_are_saved(page: Page, report: Report) -> None:
    page.value(SAVE)
    buttons = "document.querySelector('[data-robot=ground] [data-chart=\"goals reached\"] .saves').children"
    page.value(f"{buttons}[0].click()")
    saved = page.value("saved")
    picture = ElementTree.fromstring(saved["text"])
    assert saved["name"] == "goals-reached.svg" and picture.tag == "{http://www.w3.org/2000/svg}svg"
    words = [text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert "goals reached [share of episodes]" in words and "steps of all actors of the run" in words
    page.value(f"{buttons}[1].click()")
    saved = page.value("saved")
    rows = list(csv.DictReader(io.StringIO(saved["text"])))
    bins = [row for row in report[1]["training"]["ground"]["bins"] if row["goals"] is not None]
    raw = [float(row["raw"]) for row in rows if row["raw"]]
    assert saved["kind"] == "text/csv" and raw == pytest.approx([row["goals"] for row in bins])


def test_an_episode_is_saved_as_it_is_shown(page: Page) -> None:
    page.value(SAVE)
    page.value("document.querySelector('#picker .course .saves').children[1].click()")
    saved = page.value("saved")
    rows = list(csv.DictReader(io.StringIO(saved["text"])))
    facts = facts_of(page)
    assert saved["name"] == "an-episode-over-time.csv"
    assert len(rows) == int(facts["steps"])
    now = next(row for row in rows if row["step"] == facts["step"])
    assert f"{100 * float(now['clearance_m']):.3g} cm" == facts["clearance"]
    assert facts["decision"].startswith(now["decision"])
    for box in ("#picker .course", "#picker .split > div"):
        page.value(f"document.querySelector('{box} .saves').children[0].click()")
        assert ElementTree.fromstring(page.value("saved.text")).tag == "{http://www.w3.org/2000/svg}svg"


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """The report of three runs, the last one of another method, and the figures of each."""
    folder = tmp_path_factory.mktemp("compared")
    logs = [mixed(folder / name, seed, 4 + 2 * seed, later=1e4 * seed) for seed, name in enumerate(("a", "b"), 1)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ABOUT, "run", ABOUT["run"] | {"method": "none", "certificate": ""})
        logs.append(mixed(folder / "c", 3, 5, later=5e4))
    analysis = analyse_runs(logs, AnalysisOptions(pictures=True))
    write(folder / "page.html", analysis.figures(), analysis.by_label())
    return folder / "page.html", [figures for figures, _ in analysis.by_label().values()]


def test_a_full_disk_leaves_an_earlier_page(tmp_path: Path) -> None:
    analysis = analyse_runs([mixed(tmp_path / "a", 1, 4)], AnalysisOptions(pictures=True))
    page = tmp_path / "page.html"
    page.write_text("earlier")
    with full_disk(20_000), pytest.raises(OSError, match="File too large"):
        write(page, analysis.figures(), analysis.by_label())
    assert page.read_text() == "earlier"


@pytest.fixture(scope="module")
def comparison(compared: Compared, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with drawn(compared[0], tmp_path_factory.mktemp("browser")) as page:
        yield page


def test_runs_are_laid_over_each_other_and_never_joined(comparison: Page, compared: Compared) -> None:
    page, runs = comparison, compared[1]
    assert page.value("data.map(run => run.training.ground.bins.at(-1).until)") == [
        run["robots"]["ground"]["steps"] for run in runs
    ]
    lines = "[...document.querySelectorAll('[data-robot=ground] [data-chart=\"goals reached\"] polyline')]"
    page.value("document.getElementById('bands').click()")
    assert page.value(f"{lines}.map(line => line.dataset.run)") == ["a", "b", "c"]
    edges = page.value(f"{lines}.map(line => Number(line.getAttribute('points').split(' ').at(-1).split(',')[0]))")
    steps = [run["robots"]["ground"]["steps"] for run in runs]
    assert sorted(range(3), key=lambda k: edges[k]) == sorted(range(3), key=lambda k: steps[k]), "each from its own 0"
    shown = page.value("[...document.querySelectorAll('.tile [data-figure=goals]')].map(t => Number(t.dataset.value))")
    assert shown == [run["goals"] for run in runs], "nothing is pooled"
    choose = "document.querySelector('#learning-controls input[data-run=b]').click()"
    page.value(choose)
    assert page.value(f"{lines}.map(line => line.dataset.run)") == ["a", "c"]
    page.value(choose)
    page.value("document.getElementById('bands').click()")


def test_seeds_of_a_method_are_a_band_of_the_color_of_the_method(comparison: Page) -> None:
    page, chart = comparison, "document.querySelector('[data-robot=ground] [data-chart=\"goals reached\"]')"
    groups = page.value("groups.filter(group => group.robot === 'ground')")
    assert [(group["name"], group["runs"]) for group in groups] == [("ddpc", ["a", "b"]), ("none", ["c"])]
    lines = page.value(
        f"[...{chart}.querySelectorAll('polyline[data-run]')].map(l => [l.dataset.run, l.getAttribute('stroke')])"
    )
    assert lines == [["ddpc, 2 runs", groups[0]["color"]], ["none", groups[1]["color"]]]
    assert page.value(f"{chart}.querySelectorAll('.band').length") == 1
    assert page.value(f"{chart}.querySelectorAll('.some').length") == 1, "the shorter run does not cut the longer one"
    page.value("document.getElementById('bands').click()")
    assert page.value(f"{chart}.querySelectorAll('.raw').length") == 3, "raw values beside smoothed ones"
    page.value("document.getElementById('raw').click()")
    assert page.value(f"{chart}.querySelectorAll('.raw').length") == 0
    page.value("document.getElementById('raw').click()")
    page.value("document.getElementById('bands').click()")
    assert page.complaints == []


def test_groups_have_their_scores_profiles_and_differences(comparison: Page) -> None:
    page = comparison
    rows = page.value("[...document.querySelectorAll('#group-scores tbody tr')].map(row => row.dataset.group)")
    assert sorted(rows) == ["ddpc", "ddpc", "none", "none"], "a row for each robot kind"
    assert page.value("[...document.querySelectorAll('#profiles polyline')].map(l => l.dataset.group)") == rows
    assert page.value("document.querySelectorAll('#profiles figure').length") == 2
    assert page.value("document.querySelectorAll('#improvements tbody tr').length") == 2
    names = page.value("[...document.querySelectorAll('#differences tbody tr')].map(row => row.cells[0].textContent)")
    assert names == ["method", "certificate"]


def test_a_run_is_chosen_and_its_own_parts_are_shown(comparison: Page) -> None:
    page = comparison
    visible = "[...document.querySelectorAll('div.run')].filter(d => d.offsetHeight > 0).map(d => d.dataset.run)"
    assert page.value(visible) == ["a"]
    page.value("(s => { s.value = '2'; s.dispatchEvent(new Event('change')) })(document.getElementById('run'))")
    assert page.value(visible) == ["c"]
    assert page.value("document.querySelectorAll('#run2-near .card svg').length") > 4
    assert page.value("document.querySelectorAll('#run2-rates .whisker svg').length") == 8
    page.value("location.hash = '#run=1&episode=3&step=1'")
    page.until("document.getElementById('run').value === '1'")
    facts = "[...document.querySelectorAll('#run1-episode-facts dd')].find(d => d.dataset.fact === 'step').textContent"
    page.until(f"{facts} === '1'")
    assert page.complaints == []


def test_keys_step_through_an_episode(page: Page) -> None:
    page.value("document.activeElement.blur()")
    page.value("document.querySelector('#picker .plots svg') && pickers.get(0).viewer.step(0)")
    first = int(facts_of(page)["step"])
    page.press("ArrowRight")
    assert int(facts_of(page)["step"]) == first + 1
    page.until(f"location.hash.endsWith('step={first + 1}')")
    number = "document.querySelector('#picker select').value"
    before = int(page.value(number))
    page.press("n")
    assert int(page.value(number)) == before + 1
    page.press("p")
    assert int(page.value(number)) == before
    page.press("?")
    keys = "document.getElementById('keys')"
    assert page.value(f"{keys}.open && {keys}.textContent.length > 200")
    page.press("?")
    assert not page.value(f"{keys}.open")
    page.value("document.getElementById('episode-map').focus()")
    page.press("End")
    assert int(facts_of(page)["step"]) > first


@pytest.mark.parametrize("which", ["page", "comparison"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1400])
def test_layouts_hold(request: pytest.FixtureRequest, which: str, width: int, scheme: str) -> None:
    page: Page = request.getfixturevalue(which)
    page.size(width, 900)
    page.media("screen", scheme)
    assert page.value("document.documentElement.scrollWidth") <= width, "nothing sticks out"
    shade = page.value("getComputedStyle(document.querySelector('section')).backgroundColor.match(/\\d+/g).map(Number)")
    ink = page.value("getComputedStyle(document.body).color.match(/\\d+/g).map(Number)")
    assert (sum(shade) < 150 and sum(ink) > 600) if scheme == "dark" else (sum(shade) > 700 and sum(ink) < 150)
    narrow = "[...document.querySelectorAll('.charts svg')].filter(s => s.getBoundingClientRect().width > 0)"
    assert page.value(f"{narrow}.every(s => s.getBoundingClientRect().width >= 300)")
    page.media()
    page.size(1280, 900)


def test_on_paper_pages_are_full(page: Page) -> None:
    pages = len(re.findall(rb"/Type\s*/Page\b", page.pdf()))
    page.size(680, 1000)  # what A4 has room for
    page.media("print")
    height = page.value("document.documentElement.scrollHeight")
    page.media()
    page.size(1280, 900)
    assert 1 < pages <= 1 + height / 850, f"{height} px on {pages} pages: some are half-empty"
    assert pages <= 9


def test_an_empty_log_has_a_page_too(tab: Page, tmp_path: Path) -> None:
    open_segment(tmp_path / "run.mcap", {"run": {"method": TRICKS}, "odd": {TRICKS: TRICKS}}).finish()
    assert main(["analyse", str(tmp_path / "run.mcap"), "--html", str(tmp_path / "a" / "page.html"), "--json"]) == 0
    text = (tmp_path / "a" / "page.html").read_text()
    assert "alert(1)</script>" not in text
    tab.show(tmp_path / "a" / "page.html")
    assert tab.complaints == []
    assert tab.value("document.querySelectorAll('.none').length") == 6


def test_numbers_are_for_people() -> None:
    shown = [number(value) for value in (None, 0, 1234567, 0.123456, 12.0)]
    assert shown == ["–", "0", "1\u202f234\u202f567", "0.123", "12"]
    assert [percent(value) for value in (None, 0.0, 0.5, 0.00123)] == ["–", "0.0 %", "50.0 %", "0.12 %"]
    assert json.loads(embedded({"x": TRICKS, "y": float("nan")})) == {"x": TRICKS, "y": None}
    assert "<" not in embedded(TRICKS)


HOSTILE = '"><img src=x onerror="document.title=\'owned\'"></title></text><script>document.title="owned"</script>'


def hostile(path: Path, analysis: LogAnalysis) -> Path:
    """Write a page in which every text that a log can contain is a script."""
    [(figures, pictures)] = json.loads(json.dumps(list(analysis.by_label().values())))
    figures["processes"] |= {HOSTILE: next(iter(figures["processes"].values()))}
    figures["topics"] |= {HOSTILE: {"messages": 1, "missing": 1, "duplicates": 1}}
    figures["training"] = {HOSTILE: next(iter(figures["training"].values()))} | figures["training"]
    timeline = pictures["timeline"]
    timeline["lives"] += [life | {"process": HOSTILE} for life in timeline["lives"]]
    timeline["lines"].append({"t": 0.0, "process": HOSTILE, "level": HOSTILE, "text": HOSTILE})
    pictures["places"] = {HOSTILE: next(iter(pictures["places"].values()))} | pictures["places"]
    for gallery in pictures["galleries"].values():
        for episode in gallery["episodes"] + gallery["rest"]:
            episode |= {"actor": HOSTILE, "robot": HOSTILE, "arena": HOSTILE, "outcome": HOSTILE}
            for tube in episode.get("tubes", {}).values():
                tube |= {"reason": HOSTILE, "limited": HOSTILE, "said": HOSTILE}
    write(path, figures, {HOSTILE: (figures, pictures)})
    return path


def test_no_text_of_a_log_runs_as_a_script(tab: Page, tmp_path: Path, analysis: LogAnalysis) -> None:
    path = hostile(tmp_path / "hostile.html", analysis)
    bare = tmp_path / "bare.html"  # without its policy: the escaping alone must do
    bare.write_text(re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", path.read_text()))
    for place in (bare, path):
        tab.show(place)
        assert tab.value("document.querySelectorAll('img, svg script, main script').length") == 0
        assert tab.value("document.title").startswith("Brakeline: ")
        assert tab.complaints == []


def test_its_policy_lets_no_script_or_style_run_but_its_own(tab: Page, report: Report, tmp_path: Path) -> None:
    policy = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', report[0].read_text())
    assert len(policy) == 1 and "unsafe" not in policy[0] and policy[0].count("'sha256-") == 2
    injected = tmp_path / "injected.html"
    tricks = "<script>document.title = 'owned'</script><img src='data:,' onerror=\"document.title = 'owned'\">"
    injected.write_text(report[0].read_text().replace("<main>", f"<main>{tricks}", 1))
    tab.show(injected)
    assert tab.value("document.title").startswith("Brakeline: ")
    assert any("Content Security Policy" in complaint for complaint in tab.complaints)
