"""Laws of README and pages: no dead link, no missing file, no figure or message that the code does not give."""

from __future__ import annotations

import ast
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import brakeline
from brakeline import ModelSet
from brakeline.deploy.cli import parse
from brakeline.deploy.commands.campaign_command import CampaignCommand
from brakeline.deploy.experiments.compared_methods import METHODS
from brakeline.messaging.task import robot_with_task
from brakeline.sim.arena_generator import draw_arena
from tests.laws.page_tables import table_rows
from tests.laws.test_names import PARTS

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]

LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
CODE = re.compile(r"`([^`\n]+)`")
FILE = re.compile(r"[\w.+-]+/[\w./+-]*|[\w-]+\.(?:py|md|toml|proto|yaml|js)")


def dead_links(page: Path) -> list[str]:
    """Return the relative links of a page that lead to no file."""
    return [link for link in LINK.findall(page.read_text()) if not (page.parent / link).exists()]


def missing_files(table: str) -> list[str]:
    """Return the files and folders that the rows of a table name in code, and that the repository does not have."""
    missing = []
    for row in table.splitlines():
        folder = ROOT
        for code in CODE.findall(row if row.startswith("|") else ""):
            if not FILE.fullmatch(code) or code.isupper() or any(word.isupper() for word in re.split(r"[/._]", code)):
                continue  # a name that stands for a name: `policies/ROBOT/NAME.safetensors`
            if (ROOT / code).exists() or (folder / code).exists() or (ROOT / "brakeline" / code).exists():
                inside = (
                    folder != ROOT and (folder / code).exists()
                )  # a row of `deploy/` means its own `data/`, not one of a checkout
                folder = ROOT / code if (ROOT / code).is_dir() and not inside else folder
            else:
                missing.append(code)
    return missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_link_is_dead(page: Path) -> None:
    assert dead_links(page) == []


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("[a](page.md#top), [b](https://b.org/c), [d](gone.md)")
    assert dead_links(tmp_path / "page.md") == ["gone.md"]


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "extending.md"], ids=lambda page: page.name)
def test_the_tables_name_files_that_exist(page: Path) -> None:
    assert missing_files(page.read_text()) == []


def test_a_missing_file_is_found() -> None:
    table = "| `sim/` | `batch/`, `sim/arena.py` |\n| a row | `sim/gone.py` of `policies/ROBOT/NAME.safetensors` |"
    assert missing_files(table) == ["sim/gone.py"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_names_a_file_that_is_missing(page: Path) -> None:
    """Take code that begins with a folder of the repository. `brakeline/` also begins the topics of the bus."""
    codes = CODE.findall(page.read_text())
    named = [code for code in codes if FILE.fullmatch(code) and not re.search("[A-Z]{3}", code)]
    top = {folder.name for folder in ROOT.iterdir() if folder.is_dir()} - {"brakeline", "runs", "data"}
    assert [code for code in named if code.partition("/")[0] in top and not (ROOT / code).exists()] == []


def test_the_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) <= 150


@pytest.mark.parametrize("name", ["README.md", "docs/results.md"])
@pytest.mark.parametrize("robot", ["ground", "quadrotor"])
def test_the_pages_have_the_figures_of_the_comparison(name: str, robot: str) -> None:
    table = json.loads((ROOT / "results" / robot / "table.json").read_text())
    default, dense, training = (table["parts"][part] for part in ("default", "dense", "training"))
    rows = table_rows(name, f"| {robot}, after {table['steps']:,} steps |")
    for cells, method in zip(rows, default, strict=True):
        shares = [part[method][f"{what} rate"] for part in (default, dense) for what in ("goal", "collision")]
        collisions = training[method]["collisions"]
        figures = [f"{100 * share['value']:.1f} %" for share in shares] + [f"{collisions:.{int(0 < collisions < 1)}f}"]
        steps, periods = training[method]["steps to 90 % goals"]["value"], training[method]["pre-training samples"]
        label, *row = (re.split(r" [*(]", cell)[0] for cell in cells)
        assert label == METHODS[method].label and row == [*figures, f"{steps:,.0f}", f"{periods:,}"]


def with_interval(share: dict[str, float], digits: int) -> str:
    """Return a share of the table as the pages of the robots write it, such as `99.8 % [99.5, 100.0]`."""
    value, low, high = (f"{100 * share[key]:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} % [{low}, {high}]"


def rows_of_the_robots_page(robot: str) -> dict[str, list[str]]:
    """Return the rows of the table with results on a robot's page, by their first cell."""
    return {label: row for label, *row in table_rows(f"docs/results_{robot}.md", f"| {robot}, after ", heads=True)}


def test_the_page_of_the_ground_robot_has_the_figures_of_the_comparison() -> None:
    parts, rows = (
        json.loads((ROOT / "results/ground/table.json").read_text())["parts"],
        rows_of_the_robots_page("ground"),
    )
    for method, training in parts["training"].items():
        default, dense = parts["default"][method], parts["dense"][method]
        figures = [
            text
            for part in (default, dense)
            for text in (with_interval(part["goal rate"], 1), with_interval(part["collision rate"], 2))
        ]
        figures += [with_interval(training["collision rate"], 2), f"{training['steps to 90 % goals']['value']:,.0f}"]
        figures.append(", ".join(f"{100 * part['interventions']['value']:.1f} %" for part in (default, dense)))
        figures += [f"{default['mean speed [m/s]']['value']:.2f}", f"{default['mean reward']['value']:.0f}"]
        assert rows[METHODS[method].label][1:] == [*figures, f"{default['decision [ms]']:.2f}"]


def test_the_page_of_the_quadrotor_has_the_figures_of_the_comparison() -> None:
    """Shares of collisions have two digits, so that a rare collision does not read as none."""
    parts = json.loads((ROOT / "results/quadrotor/table.json").read_text())["parts"]
    rows, training = rows_of_the_robots_page("quadrotor"), parts["training"]
    assert rows["quadrotor, after 120,000 training steps"] == [METHODS[method].label for method in training]
    for column, method in enumerate(training):
        for arena in ("default", "dense"):
            share = parts[arena][method]
            assert rows[f"goals, `{arena}`"][column] == with_interval(share["goal rate"], 1)
            assert rows[f"collisions, `{arena}`"][column] == with_interval(share["collision rate"], 2)
        collided = with_interval(training[method]["collision rate"], 2)
        assert rows["episodes of training with a collision"][column] == collided
        steps = training[method]["steps to 90 % goals"]
        mean, each = f"{steps['value']:,.0f}", ", ".join(f"{seed:,.0f}" for seed in steps["seeds"])
        assert rows["steps to 90 % of goals: mean; each seed"][column] == f"{mean}; {each}"


@pytest.mark.parametrize("name", ["README.md", "docs/faq.md", "docs/index.md"])
def test_the_pages_state_the_bounds_of_the_shipped_model_sets(name: str) -> None:
    """A bound is rounded up."""
    text = (ROOT / name).read_text()
    for robot in ("ground", "quadrotor"):
        bound = float(ModelSet.load(robot).about["bound_plan"])
        assert f"{math.ceil(1e4 * bound) / 100:.2f} %" in text, robot


def texts_in_code() -> str:
    """Return every string of the package, with … in place of each value that is filled in."""
    found = []
    for part in PARTS:
        for file in (ROOT / part).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.JoinedStr):
                    found.append("".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.append(node.value)
    return "\n".join(found)


def test_every_message_of_troubleshooting_is_in_the_code() -> None:
    page, code = (ROOT / "docs" / "troubleshooting.md").read_text(), texts_in_code()
    messages = re.findall(r"^\| `([^`]+(?:`[^`|]+`[^`|]*)*)` \|", page, re.MULTILINE)
    assert len(messages) > 20
    parts = [part.strip() for message in messages for part in message.split("…")]
    assert [part for part in parts if part and part not in code] == []


def test_the_tutorial_shows_the_example_as_it_is() -> None:
    page = (ROOT / "docs" / "tutorial_4_policy.md").read_text()
    assert f"```python\n{(ROOT / 'examples' / 'my_policy.py').read_text()}```" in page


def test_the_task_of_the_page_is_one_of_an_omnidirectional_robot(tmp_path: Path) -> None:
    [text] = re.findall(r"```toml\n(simulator.*?)```", (ROOT / "docs" / "your_robot.md").read_text(), re.DOTALL)
    (tmp_path / "my.toml").write_text((ROOT / "examples" / "omni" / "omni.toml").read_text().replace('"omni"', '"my"'))
    (tmp_path / "my.task.toml").write_text(text)
    robot = robot_with_task(tmp_path / "my.toml")
    arena = draw_arena("default", np.random.default_rng(0), robot)
    senses = robot.task.code(robot.task.senses)(robot, arena, np.random.default_rng(0), 0.0)
    state = np.zeros(robot.state_dim)
    assert senses.observe(state, state, robot.zero_input()).shape == (robot.task.observation_dim,)


def commands(page: str) -> list[str]:
    """Return the commands of a page without redirections and comments; not those with a … in them."""
    lines = re.findall(r"^ *(brakeline [^\n]+)$", re.sub(r"\\\n *", " ", page), re.MULTILINE)
    return [line.partition(" > ")[0] for line in lines if "…" not in line and "..." not in line]


@pytest.mark.parametrize("page", [README, *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name)
def test_every_command_of_the_pages_can_be_parsed(page: Path) -> None:
    """A campaign also takes the numbers of its command."""
    for command in commands(page.read_text()):
        name, *words = shlex.split(command, comments=True)[1:]
        parsed = parse(name, words)
        if isinstance(parsed, CampaignCommand):
            parsed.check_options()


def test_every_command_that_a_new_description_names_can_be_parsed() -> None:
    named = re.findall(r"`brakeline ([^`\n]+)`", (ROOT / "robots" / "template.txt").read_text())
    assert len(named) > 1
    for name, *words in map(shlex.split, named):
        parse(name, words)


def test_every_public_name_is_in_the_reference() -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    shown = re.findall(r"^::: brakeline\.(\w+)$", page, re.MULTILINE)
    assert sorted(shown) == sorted(set(brakeline.__all__) - {"__version__"})
