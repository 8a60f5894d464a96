"""Laws of the figures on README and pages: they are those of the stored cells of the comparisons."""

from __future__ import annotations

import json
import math
import re
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import stdtrit

from brakeline.deploy.experiments.compared_methods import METHODS
from brakeline.deploy.experiments.comparison_table import evaluation_name, steps_to_learn
from brakeline.learner.lagrange import LagrangeMultiplier
from tests.laws.page_tables import table_rows

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
ROBOTS = ("ground", "quadrotor")


@cache
def cells(folder: str, method: str) -> list[dict[str, Any]]:
    """Return the stored cells of a method in a folder of `results/`, by seed."""
    paths = [path for path in (RESULTS / folder).glob(f"{method}-s*.json") if re.search(r"-s\d+$", path.stem)]
    return sorted((json.loads(path.read_text()) for path in paths), key=lambda cell: cell["study"]["seed"])


def seeds(stored: list[dict[str, Any]]) -> list[int]:
    return [cell["study"]["seed"] for cell in stored]


def counts(stored: list[dict[str, Any]], arena: str, column: str) -> list[int]:
    """Return the sum of a column over the episodes of an evaluation, for each seed."""
    trial = evaluation_name(stored[0]["study"]["method"], arena)
    return [sum(cell["evaluations"][trial]["episodes"][column]) for cell in stored]


def shares(stored: list[dict[str, Any]], arena: str, column: str) -> list[float]:
    """Return the share of an evaluation's episodes, of interventions that of its steps, for each seed."""
    of = [cell["study"]["episodes"] for cell in stored]
    of = counts(stored, arena, "steps") if column == "interventions" else of
    return [count / all_of for count, all_of in zip(counts(stored, arena, column), of, strict=True)]


def learned(stored: list[dict[str, Any]]) -> list[float]:
    return [steps_to_learn(cell["training"]["episodes"], cell["training"]["steps"]) for cell in stored]


def percents(stored: list[dict[str, Any]], column: str, joint: str = ", ") -> str:
    """Return the mean shares in both arenas, such as `99.8 %, 99.6 %`."""
    return joint.join(f"{100 * np.mean(shares(stored, arena, column)):.1f} %" for arena in ("default", "dense"))


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("table.json")), ids=lambda path: str(path.relative_to(RESULTS)))
def test_a_stored_table_is_of_the_stored_cells(path: Path) -> None:
    """The intervals are those of `brakeline compare --table`; they are not drawn again here."""
    table, folder = json.loads(path.read_text()), str(path.parent.relative_to(RESULTS))
    methods = {found[1] for cell in path.parent.glob("*.json") if (found := re.fullmatch(r"(.+)-s\d+", cell.stem))}
    assert methods == set(table["seeds"])
    for method, numbers in table["seeds"].items():
        stored, training = cells(folder, method), table["parts"]["training"][method]
        assert seeds(stored) == numbers and training["steps to 90 % goals"]["seeds"] == learned(stored)
        collisions = [sum(cell["training"]["episodes"]["collision"]) for cell in stored]
        assert training["collisions"] == pytest.approx(np.mean(collisions))
        for arena in ("default", "dense"):
            row = table["parts"][arena][method]
            for name, column in (("goal rate", "goal"), ("collision rate", "collision"), ("interventions",) * 2):
                assert row[name]["seeds"] == pytest.approx(shares(stored, arena, column)), (method, arena, name)
                assert row[name]["low"] <= row[name]["value"] <= row[name]["high"]


@pytest.mark.parametrize("name", ["README.md", "docs/results.md"])
def test_the_pages_say_how_often_the_recordings_collided_and_what_all_goals_mean(name: str) -> None:
    text = " ".join((ROOT / name).read_text().split())
    training = {
        robot: json.loads((RESULTS / robot / "table.json").read_text())["parts"]["training"] for robot in ROBOTS
    }
    ground, air = ({row: part[row]["pre-training collisions"] for row in part} for part in training.values())
    said = f"SAILR {ground['sailr']:,} (ground) and {air['sailr']:,} (air), SECAS {ground['secas']:,} and"
    assert f"{said} {air['secas']:,}, ours {max(ground['ddpc'], air['ddpc'])}" in text
    assert {sum(counts(cells(robot, "ddpc"), "default", "goal")) for robot in ROBOTS} == {2499}
    assert "2,499 of 2,500 episodes" in text


def test_the_page_counts_the_recorded_periods_of_sac_behind_our_filter() -> None:
    ground, air = (cells(robot, "sac-ddpc")[0]["model"]["samples"] for robot in ROBOTS)
    with_recording = [
        f"{int(samples) + np.mean(learned(cells(robot, 'sac-ddpc'))):,.0f}"
        for robot, samples in zip(ROBOTS, (ground, air), strict=True)
    ]
    text = " ".join((ROOT / "docs/results.md").read_text().split())
    assert "it needs {} periods on the ground and {} in the air".format(*with_recording) in text


@pytest.mark.parametrize(
    ("decision", "folder"), [("closest input", "closest_input/ground"), ("turning aside", "ground")]
)
def test_the_rows_of_the_deadlock_have_the_stored_figures(decision: str, folder: str) -> None:
    stored = cells(folder, "ddpc")
    figures = []
    for arena in ("default", "dense"):
        corrected = ", ".join(f"{100 * share:.1f}" for share in shares(stored, arena, "interventions"))
        figures += [", ".join(map(str, counts(stored, arena, "goal"))), f"{corrected} %"]
    rows = table_rows("docs/results_ground.md", "| robots at once |")
    assert ["16", decision, decision, *figures, f"{np.mean(learned(stored)):,.0f}"] in rows


@pytest.mark.parametrize("name", ["README.md", "docs/results.md", "docs/results_ground.md"])
def test_the_pages_say_what_ours_reaches_without_turning_aside(name: str) -> None:
    stored, text = cells("closest_input/ground", "ddpc"), " ".join((ROOT / name).read_text().split())
    default, dense = percents(stored, "goal").split(", ")
    assert f"{default} and {dense}" in text or f"{default} and, in `dense`, {dense}" in text
    assert f"{np.mean(learned(stored)):,.0f}" in text


@pytest.mark.parametrize(("page", "robot"), [("docs/results.md", "ground"), ("docs/results_quadrotor.md", "quadrotor")])
def test_the_pages_say_how_sure_the_difference_to_the_barrier_function_is(page: str, robot: str) -> None:
    """Welch's interval of the difference of the mean shares of goals in `dense`, over the runs."""
    ours, theirs = (np.array(shares(cells(robot, method), "dense", "goal")) for method in ("ddpc", "cbf"))
    parts = [np.var(runs, ddof=1) / len(runs) for runs in (ours, theirs)]
    freedom = sum(parts) ** 2 / sum(part**2 / (len(ours) - 1) for part in parts)
    difference, half = np.mean(ours) - np.mean(theirs), stdtrit(freedom, 0.975) * math.sqrt(sum(parts))
    text = " ".join((ROOT / page).read_text().split())
    assert f"{100 * difference:.1f} percentage points" in text
    assert f"{100 * (difference - half):.1f} to {100 * (difference + half):.1f} by Welch's t-test" in text


def test_the_page_says_how_often_the_predictive_filter_with_a_hard_margin_finds_no_plan() -> None:
    def without_plan(folder: str, method: str, arena: str) -> float:
        evaluations = [cell["evaluations"][evaluation_name(method, arena)] for cell in cells(folder, method)]
        failsafes = sum(evaluation["logged"]["failsafes"] for evaluation in evaluations)
        return failsafes / sum(sum(evaluation["episodes"]["interventions"]) for evaluation in evaluations)

    arenas = ("default", "dense")
    ground, air = (
        " and ".join(f"{100 * without_plan(f'psf_hard/{robot}', 'psf', arena):.0f}" for arena in arenas)
        for robot in ROBOTS
    )
    assert max(without_plan(robot, "cbf", arena) for robot, arena in product(ROBOTS, arenas)) < 0.01
    text = " ".join((ROOT / "docs/rivals.md").read_text().split())
    assert f"{ground} % of PSF's interventions on the ground, and {air} % in the air" in text
    text, stored = " ".join((ROOT / "docs/results_ground.md").read_text().split()), cells("psf_hard/ground", "psf")
    default, dense = percents(stored, "goal").split(", ")
    first, second = percents(stored, "interventions").split(", ")
    assert f"{default} and {dense} of goals, needed {np.mean(learned(stored)):,.0f} steps" in text
    assert f"corrected {first} and {second} of the steps (`results/psf_hard`" in text


def test_the_page_says_how_far_the_multiplier_of_td3_lagrange_rose() -> None:
    text = " ".join((ROOT / "docs/rivals.md").read_text().split())
    costs, collided, ranges = [], [], []
    for robot in ROBOTS:
        highest, stored = [], cells(robot, "lagrange")
        for cell in stored:
            td3, episodes = cell["study"]["td3"], cell["training"]["episodes"]
            multiplier, values = LagrangeMultiplier(td3["cost_limit"], td3["multiplier_rate"]), [0.0]
            for number in np.argsort(episodes["end"], kind="stable"):
                multiplier.end_episode(bool(episodes["collision"][number]))
                values.append(multiplier.value)
            highest.append(max(values))
            assert multiplier.value > 0.98 * max(values), "it rises to the end, so it has not settled"
        ranges.append(f"{min(highest):.0f} to {max(highest):.0f}")
        costs.append(f"{100 + max(highest):.0f}")
        collided.append(f"{100 * np.mean([np.mean(cell['training']['episodes']['collision']) for cell in stored]):.1f}")
    assert f"no training reached the limit: {collided[0]} % (ground) and {collided[1]} % (air)" in text
    assert f"rose to {ranges[0]} on the ground, and to {ranges[1]} in the air" in text
    assert f"a collision cost at most {' and '.join(costs)} instead of 100" in text


def sac_cells(robot: str, method: str, rate: float) -> list[dict[str, Any]]:
    """Return the stored cells of SAC with a learning rate, wherever they are stored but the longer trainings."""
    folders = [path.parent for path in RESULTS.rglob(f"{robot}/table.json") if "plateau" not in path.parts]
    stored = [cell for folder in folders for cell in cells(str(folder.relative_to(RESULTS)), method)]
    stored = [cell for cell in stored if cell["study"]["td3"]["actor_rate"] == rate]
    assert len(set(seeds(stored))) == len(stored)
    return sorted(stored, key=lambda cell: cell["study"]["seed"])


NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def test_the_table_of_sacs_learning_rates_has_the_stored_figures() -> None:
    """A row: the rate, and SAC; SAC with our filter. Figures that no stored cell has must name a commit."""
    for rate, steps, goals, collisions, places in table_rows("docs/results.md", "| learning rate |"):
        robot = "quadrotor" if re.search("air|quadrotor", rate) else "ground"
        columns = [cell.split("; ") for cell in (steps, goals, collisions, places)]
        for method, *figures, place in zip(("sac", "sac-ddpc"), *columns, strict=True):
            stored = sac_cells(robot, method, float(re.findall(r"0\.\d+", rate)[0]))
            if not stored:
                assert "commit" in place, (rate, method)
                continue
            collided = [sum(cell["training"]["episodes"]["collision"]) for cell in stored]
            expected = f"{np.mean(learned(stored)):,.0f}", percents(stored, "goal", " and ")
            assert figures == [*expected, f"{np.mean(collided):.0f}"], (rate, method)
            numbers = seeds(stored)
            spelled = [f"{NUMBERS[len(stored)]} seed", f"seeds {', '.join(map(str, numbers))}"]
            spelled += [f"seeds {numbers[0]} to {numbers[-1]}"] * (numbers == [*range(numbers[0], numbers[-1] + 1)])
            assert any(words in place for words in spelled), (rate, method, place)


def test_the_page_of_the_ground_robot_says_how_many_steps_sac_needs_at_both_learning_rates() -> None:
    text = (ROOT / "docs/results_ground.md").read_text()
    for method, rate in (("sac", 0.0003), ("sac-ddpc", 0.0003), ("sac-ddpc", 0.003)):
        assert f"{np.mean(learned(sac_cells('ground', method, rate))):,.0f}" in text, (method, rate)


OTHERS = {  # rows of the table of other settings, with the folder and the method of their cells
    "TD3, 300,000 steps": ("plateau/quadrotor", "none"),
    "SAILR, 300,000 steps": ("plateau/quadrotor", "sailr"),
    "SAILR, η = 0.15, 300,000 steps": ("former_plateau/quadrotor", "sailr"),
    "SECAS, 300,000 steps": ("plateau/quadrotor", "secas"),
    "PSF, 300,000 steps": ("plateau/quadrotor", "psf"),
    "PSF, hard margin 0.4 m, 300,000 steps": ("former_plateau/quadrotor", "psf"),
    "PSF, hard margin 0.4 m": ("psf_hard/quadrotor", "psf"),
    "TD3-Lagrange, 300,000 steps": ("plateau/quadrotor", "lagrange"),
    "SAC, 300,000 steps": ("plateau/quadrotor", "sac"),
    "SAILR, η = 0.15": ("former_settings/quadrotor", "sailr"),
    "CBF-QP, α = 2": ("former_settings/quadrotor", "cbf"),
    "SECAS, margin 0.4 m": ("former_settings/quadrotor", "secas"),
    "SECAS, penalty for corrections 12": ("secas_penalty_12/quadrotor", "secas"),
    "TD3-Lagrange, multiplier rate 1": ("lagrange/quadrotor", "lagrange"),
}


def test_the_table_of_other_settings_has_the_stored_figures() -> None:
    """One seed: numbers of collisions; several: shares. A row of SAC without a stored cell says so."""
    tied = set()
    for label, *row in table_rows("docs/results_quadrotor.md", "| training | seeds | goals | collisions |"):
        rate = re.fullmatch(r"SAC behind our filter, (?:(?:learning )?rate )?(0\.\d+)(?:, .*)?", label)
        if not rate and label not in OTHERS:
            continue
        stored = sac_cells("quadrotor", "sac-ddpc", float(rate[1])) if rate else cells(*OTHERS[label])
        tied.add(label)
        if not stored:
            assert "commit" in label or "not stored" in label, label
            continue
        collided = [sum(counts(stored, arena, "collision")) for arena in ("default", "dense")]
        many, reached = ", ".join(map(str, collided)), learned(stored)
        percent = percents(stored, "collision") if len(stored) > 1 and any(collided) else many
        steps = f"{np.mean(reached):,.0f}" if min(reached) < stored[0]["study"]["steps"] else "not reached"
        filtered = METHODS[stored[0]["study"]["method"]].filter != "none"
        expected = [str(len(stored)), percents(stored, "goal"), percent]
        assert [*row[:3], *row[4:]] == [*expected, steps, percents(stored, "interventions") if filtered else "–"], label
        training = [cell["training"]["episodes"]["collision"] for cell in stored]
        total, episodes = sum(map(sum, training)), sum(map(len, training))
        said = row[3].removesuffix(" episodes").split(" in ")
        each = said[1:] == ["each"]
        assert said[0] == f"{total / len(stored) if each else total:,.0f}" and (
            each or said[1:] in ([], [f"{episodes:,}"])
        )
    assert tied >= set(OTHERS)


def test_the_table_of_minutes_of_driving_has_the_stored_figures() -> None:
    """*With the recording* adds the periods that were recorded before; TD3 has none."""
    rows = table_rows("docs/results.md", "| robot | recorded before |")
    assert [row[0] for row in rows] == ["ground", "quadrotor"]
    for robot, recorded, _, number, *figures in rows:
        stored, alone = cells(f"minutes/{robot}", "ddpc"), cells(robot, "none")
        assert {(cell["study"]["model_config"]["mode"], cell["study"]["steps"]) for cell in stored} == {
            ("one-step", alone[0]["study"]["steps"])
        }
        (samples,) = {int(cell["model"]["samples"]) for cell in stored}
        evaluated = [sum(counts(stored, arena, "collision")) for arena in ("default", "dense")]
        training = [cell["training"]["episodes"]["collision"] for cell in stored]
        collided = f"{sum(evaluated)}; {sum(map(sum, training))} of {sum(map(len, training)):,}"
        steps, without = np.mean(learned(stored)), np.mean(learned(alone))
        assert recorded.endswith(f" {samples:,} periods") and number == str(len(stored))
        assert figures == [
            percents(stored, "goal"), percents(stored, "interventions"), collided, f"{steps:,.0f}",
            f"{samples + steps:,.0f}", f"{without:,.0f}",
        ]  # fmt: skip
        for page in ("README.md", f"docs/results_{robot}.md"):
            assert f"{samples + steps:,.0f}" in (ROOT / page).read_text(), page


FEWER = {  # rows of the table of fewer corrections, likewise
    "ours, neither": ("fewer_corrections/neither/quadrotor", "ddpc"),
    "ours, imitation 1": ("fewer_corrections/imitation/quadrotor", "ddpc"),
    "ours, growth 4": ("fewer_corrections/growth/quadrotor", "ddpc"),
    "ours, both": ("fewer_corrections/both/quadrotor", "ddpc"),
    "ours, both, with today's clearance margin (the table above)": ("quadrotor", "ddpc"),
    "CBF-QP, α = 2, neither": ("fewer_corrections/neither/quadrotor", "cbf"),
    "CBF-QP, α = 2, both": ("former_settings/quadrotor", "cbf"),
    "SECAS, 0.4 m, neither": ("fewer_corrections/neither/quadrotor", "secas"),
    "SECAS, 0.4 m, both": ("former_settings/quadrotor", "secas"),
}


def test_the_table_of_fewer_corrections_has_the_stored_figures() -> None:
    rows = {
        label.strip("*"): row for label, *row in table_rows("docs/results_quadrotor.md", "| training | seeds | steps")
    }
    assert set(rows) == set(FEWER)
    for label, (folder, method) in FEWER.items():
        stored = cells(folder, method)
        episodes = [cell["study"]["episodes"] for cell in stored]
        steps = np.mean(np.array(counts(stored, "default", "steps")) / episodes)
        without = [cell["evaluations"].get("trained-none-default") for cell in stored]
        collided = [np.mean(one["episodes"]["collision"]) for one in without if one]
        figures = [str(len(stored)), f"{np.mean(learned(stored)):,.0f}", percents(stored, "goal")]
        figures += [percents(stored, "interventions"), f"{steps:.1f}"]
        assert rows[label] == [*figures, f"{100 * np.mean(collided):.1f} %" if collided else "–"], label


def test_psf_is_no_better_with_a_larger_margin() -> None:
    folder, page = RESULTS / "psf_margins" / "quadrotor", (ROOT / "docs" / "results_quadrotor.md").read_text()
    own, *larger = (
        json.loads((folder / f"tuning-psf-{margin}.json").read_text()) for margin in ("0.6", "0.8", "1", "1.5")
    )
    assert {row["oracle_goals"] for row in (own, *larger)} == {own["episodes"]} == {120}
    assert own["greedy_collisions"] == 1
    collisions = [row["greedy_collisions"] for row in larger]
    assert f"With 0.8, 1 and 1.5 m, it has {collisions[0]}, {collisions[1]} and {collisions[2]}" in page
    shares = [f"{100.0 * row['oracle_interventions']:.1f} %" for row in (*larger, own)]
    assert "{}, {} and {} of A*'s steps instead of {}".format(*shares) in " ".join(page.split())
