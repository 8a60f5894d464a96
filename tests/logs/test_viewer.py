"""The viewer of the report: in space, from above and from the side; links, curves and keys lead to an episode."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from brakeline.deploy.run.episode_render import COLOURS
from brakeline.logs import foxglove_scene
from brakeline.logs.episode_sampler import POINTS, EpisodeSampler
from brakeline.logs.episode_stats import KINDS
from brakeline.logs.log_analysis import LogAnalysis
from brakeline.logs.report_page import render
from brakeline.logs.viewer import SCRIPTS, hex_color, rgb_color, viewer_file
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import Robot
from tests.browser import Page
from tests.logs.sample_log import Writer
from tests.robots import GROUND, QUADROTOR

STAGE = "document.querySelector('#picker .stage')"
FACT = "[...document.querySelectorAll('#episode-facts dd')].find(d => d.dataset.fact === '{}').textContent"
PIXELS = """(() => { const c = document.querySelector('#picker canvas'), seen = new Set();
    const data = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
    for (let i = 0; i < data.length; i += 4 * 97) seen.add(data.slice(i, i + 3).join());
    return seen.size; })()"""
SHOT = "document.querySelector('#picker canvas').toDataURL()"


def view(page: Page, name: str) -> None:
    page.value(f"document.querySelector('#picker [data-view={name}]').click()")


def frame(page: Page, change: str) -> None:
    """Make a change, and wait until the canvas has been drawn again."""
    frames = "Number(document.querySelector('#picker canvas').dataset.frames ?? 0)"
    before = page.value(frames)
    page.value(change)
    page.until(f"{frames} > {before}")


@pytest.fixture
def flight(page: Page) -> Iterator[Page]:
    """The page at an episode of the quadrotor."""
    page.value("(p => p.show(p.all.findIndex(i => i.robot === 'quadrotor' && !i.episode.at)))(pickers.get(0))")
    yield page
    page.value("pickers.get(0).viewer.look('space')")
    page.value("pickers.get(0).show(0)")


def test_an_episode_is_drawn_in_space_and_can_be_turned(flight: Page) -> None:
    view(flight, "space")
    flight.until("document.querySelector('#picker canvas').dataset.frames > 0")
    frame(flight, "pickers.get(0).viewer.draw()")
    assert flight.value(PIXELS) > 20, "a picture, not an empty canvas"
    before = flight.value(SHOT)
    flight.value("document.activeElement.blur()")
    frame(flight, "document.dispatchEvent(new KeyboardEvent('keydown', { key: 'd', bubbles: true }))")
    turned = flight.value(SHOT)
    assert turned != before, "keys turn it"
    flight.value("document.querySelector('#picker canvas').scrollIntoView({ block: 'center' })")
    x, y = flight.value(f"(r => [r.x + r.width / 2, r.y + r.height / 2])({STAGE}.getBoundingClientRect())")
    flight.mouse("Moved", x, y)
    flight.mouse("Pressed", x, y)
    flight.mouse("Moved", x + 60, y + 20)
    flight.mouse("Released", x + 60, y + 20)
    frame(flight, "pickers.get(0).viewer.draw()")
    assert flight.value(SHOT) != turned, "the mouse turns it"
    frame(flight, "pickers.get(0).viewer.home()")
    frame(flight, "pickers.get(0).viewer.draw()")
    assert flight.complaints == []


def test_in_the_air_there_are_a_side_view_and_the_altitude_and_no_grey_map(flight: Page) -> None:
    view(flight, "side")
    assert "from the side" in flight.value(f"{STAGE}.querySelector('svg').getAttribute('aria-label')")
    assert flight.value("document.querySelectorAll('#picker [data-plot]').length") == 2
    words = flight.value("document.querySelector('#picker [data-plot=altitude]').textContent")
    assert "altitude [m]" in words and "floor" in words and "ceiling" in words
    view(flight, "above")
    covered = f"""(svg => {{ const all = svg.viewBox.baseVal.width;
        const wide = [...svg.querySelectorAll('polygon[fill="var(--obstacle)"]')].map(p => p.getBBox().width);
        return wide.filter(width => width > 0.9 * all && width < 10 * all).length; }})({STAGE}.querySelector('svg'))"""
    assert flight.value(covered) == 0, "neither the floor nor the ceiling covers the map"
    flight.value("pickers.get(0).show(pickers.get(0).all.findIndex(i => i.robot === 'ground'))")
    assert flight.value("document.querySelectorAll('#picker [data-plot]').length") == 1
    assert flight.value("document.querySelector('#picker [data-view=side]').hidden")


def test_without_webgl_the_page_says_so_and_draws_the_plan(tab: Page, report: tuple[Path, dict[str, Any]]) -> None:
    without = "HTMLCanvasElement.prototype.getContext = () => null"
    script = tab.call("Page.addScriptToEvaluateOnNewDocument", source=without)
    tab.show(report[0])
    tab.call("Page.removeScriptToEvaluateOnNewDocument", **script)
    assert "no WebGL" in tab.value("document.querySelector('#picker .nowebgl').textContent")
    assert tab.value(f"{STAGE}.querySelector('svg') !== null")
    assert tab.value("document.querySelector('#picker [data-view=space]').disabled")
    tab.press("v")
    tab.press("d")
    assert tab.value(f"{STAGE}.querySelector('svg') !== null") and tab.complaints == []


def test_links_arrive_at_the_episode_and_its_step(page: Page) -> None:
    top = "document.getElementById('episodes').getBoundingClientRect().top"
    found = "pickers.get(0).all.find(i => i.robot === 'ground' && !i.episode.at && i.episode.steps > 9).episode"
    actor, number = page.value(f"(e => [e.actor, e.episode])({found})")
    for place, step in (("step=7", "7"), (f"time={4 * GROUND.period}", "4")):
        page.value("scrollTo(0, 0)")
        page.value(f"location.hash = '#episode-{number}&actor={actor}&{place}'")
        page.until(f"{FACT.format('step')} === '{step}' && Math.abs({top}) < 200")
        assert (page.value(FACT.format("actor")), page.value(FACT.format("episode"))) == (actor, str(number))
    page.value(f"location.hash = '#episode-{number}'")
    page.until(f"{FACT.format('episode')} === '{number}'")
    page.value("location.hash = '#episode-123456'")
    page.until("document.getElementById('message').textContent.includes('does not have episode 123456')")
    page.value("location.hash = ''")
    links = page.value("[...document.querySelectorAll('#contents a')].map(a => a.getAttribute('href'))")
    assert "#episodes" in links and len(links) > 8
    assert page.value("[...document.querySelectorAll('#contents a')].every(a => document.querySelector(a.hash))")


def test_one_line_crosses_all_charts_a_drag_zooms_and_a_click_opens_the_episode(page: Page) -> None:
    chart = "document.querySelector('[data-robot=ground] [data-chart=\"interventions\"] svg')"
    page.value(f"{chart}.scrollIntoView({{ block: 'center' }})")
    x, y, width, height = page.value(f"(r => [r.x, r.y, r.width, r.height])({chart}.getBoundingClientRect())")
    middle = y + 0.5 * height
    page.mouse("Moved", x + 0.5 * width, middle)
    lines = "[...document.querySelectorAll('.cross')].filter(c => c.style.display === 'inline').length"
    assert page.value(lines) >= page.value("document.querySelectorAll('[data-robot=ground] .chart').length") > 3
    page.mouse("Pressed", x + 0.4 * width, middle)
    page.mouse("Moved", x + 0.6 * width, middle)
    page.mouse("Released", x + 0.6 * width, middle)
    assert not page.value("document.getElementById('whole').hidden"), "zoomed"
    page.value("document.getElementById('whole').click()")
    assert page.value("document.getElementById('whole').hidden")
    page.mouse("Pressed", x + 0.5 * width, middle)
    page.mouse("Released", x + 0.5 * width, middle)
    step = page.value("pickers.get(0).episode.until")
    assert page.value("pickers.get(0).all[pickers.get(0).at].robot") == "ground"
    share = ((0.5 * 496) - 56) / (486 - 56)
    wanted = share * page.value("data[0].training.ground.bins.at(-1).until")
    others = page.value("pickers.get(0).all.filter(i => i.robot === 'ground').map(i => i.episode.until)")
    assert step in {min(until for until in others if until >= near * wanted) for near in (0.99, 1.0, 1.01)}
    page.value("scrollTo(0, 0)")
    assert page.complaints == []


def test_all_programs_have_the_colors_of_the_pages() -> None:
    assert hex_color("allowed") == "#2b6cb8" and rgb_color("allowed") == (0x2B, 0x6C, 0xB8)
    in_foxglove = foxglove_scene.EXECUTED
    assert [round(255 * value) for value in (in_foxglove.r, in_foxglove.g, in_foxglove.b)] == [*rgb_color("executed")]
    assert {kind: hex_color(kind) for kind in KINDS.values()} | {"no filter": hex_color("unfiltered")} == COLOURS
    folder = Path(__file__).parents[2] / "logs"
    own = [name for name in SCRIPTS if name != "three.min.js"]
    scripts = {name: viewer_file(name) for name in own}
    scripts |= {
        path.name: path.read_text() for place in ("report_page", "watch") for path in (folder / place).glob("*.js")
    }
    scripts["learning.js"] = re.sub(r"const COLORS = .*", "", scripts["learning.js"])  # of runs
    scripts["save.js"] = scripts["save.js"].replace("#fff", "")  # the paper of a saved figure
    found = {name: re.findall(r"#[0-9a-f]{3,8}\b", text) for name, text in scripts.items()}
    assert {name: colors for name, colors in found.items() if colors} == {}


@pytest.mark.parametrize(("robot", "length", "episodes"), [(GROUND, 85, 706), (QUADROTOR, 200, 300)])
def test_the_page_of_60000_steps_has_every_episode_in_three_megabytes(
    analysis: LogAnalysis, robot: Robot, length: int, episodes: int
) -> None:
    sampler, writer, dim = EpisodeSampler(robot), Writer(5), robot.position_dim
    source = sampler.source("actor-0")
    steps = [writer._step("actor-0", 0, k, robot.name, 0) for k in range(length)]
    source.exchanges.extend(writer._exchange(step, dim) for step in steps)
    others = [pb.Step.FromString(step.SerializeToString()) for step in steps]  # the sampler still has those before
    clearances = [step.clearance for step in steps]
    box = pb.Obstacle(kind="box", position=[1.2345] * dim, size=[0.3214] * dim, yaw=0.5)
    around = [box] * (12 if dim == 2 else 24)
    around += [pb.Obstacle(kind="wall", position=[2.5, 0.0, 0.0][:dim], yaw=0.5) for _ in range(4)]
    for number in range(episodes):
        about = pb.Episode(robot=robot.name, actor="actor-0", episode=number, arena="default", obstacles=around)
        about.goal[:], about.start[:], about.goal_radius = [1.2345] * dim, [0.1234] * robot.state_dim, 0.25
        source.about.append(about)
        for exchange in source.exchanges:
            exchange.request.episode = number
        for step, clearance in zip((steps, others)[number % 2], clearances, strict=True):
            step.episode, step.clearance = number, clearance + 1.0 / (1 + number)  # each one nearer than before
            sampler.step(source, step)
    sampler.close()
    gallery = sampler.figures()
    [(label, (figures, pictures))] = analysis.by_label().items()
    page = render(analysis.figures(), {label: (figures, pictures | {"galleries": {robot.name: gallery}})})
    assert len(gallery["episodes"]) + len(gallery["rest"]) == episodes == gallery["total"]
    assert sum(len(item["at"]) for item in gallery["rest"]) < 4 * POINTS
    assert len(page) < 3_000_000, f"{len(page)} bytes"


def test_of_too_many_episodes_evenly_spread_ones_are_kept() -> None:
    sampler = EpisodeSampler(GROUND, sketches=50)
    source = sampler.source("actor-0")
    for number in range(300):
        for k in range(2):
            step = pb.Step(robot="ground", actor="actor-0", episode=number, step=k, state=[0.1] * 5, clearance=1.0)
            step.truncated = k == 1
            sampler.step(source, step)
    sampler.close()
    gallery = sampler.figures()
    spread = [item["order"] for item in gallery["rest"]]
    assert 12 < len(spread) <= 50 and gallery["total"] == 300
    assert spread[0] < 30 and spread[-1] > 270
