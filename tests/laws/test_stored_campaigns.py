"""Laws of the figures of campaigns: tables and pages have those of the stored files."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from brakeline.deploy.experiments.campaign import markdown
from brakeline.logs.proportion_intervals import clopper_pearson
from tests.laws.page_tables import table_rows

pytestmark = pytest.mark.fast

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"

Cell = dict[str, Any]
COUNTED = (("goals", "episodes"), ("collisions", "episodes"), ("violations", "compared"))


def stored(*files: str) -> dict[tuple[str, str, str], Cell]:
    """Return the cells of campaigns by arena, policy and perturbation."""
    cells = [cell for file in files for cell in json.loads((RESULTS / f"{file}.json").read_text())["cells"]]
    return {(cell["arena"], cell["policy"], cell["perturbation"]): cell for cell in cells}


def says(text: str, values: Sequence[float]) -> bool:
    """Return whether a text has these numbers, each rounded to the digits that the text has."""
    numbers = re.findall(r"-?\d+(?:\.\d+)?", text.replace(",", "") if " of " in text else text)
    near = (
        abs(value - float(number)) <= 0.5 * 10.0 ** -len(number.partition(".")[2]) + 1e-9
        for number, value in zip(numbers, values, strict=False)
    )
    return 0 < len(numbers) <= len(values) and all(near)


def share(cell: Cell, what: str, of: str) -> list[float]:
    """Return a share and its interval [%]."""
    return [100.0 * value for value in (cell[what] / cell[of], *cell[f"{what}_interval"])]


@pytest.mark.parametrize(
    "path", sorted(RESULTS.glob("campaign*/*.json")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_a_stored_campaign_has_exact_intervals_and_its_table(path: Path) -> None:
    table = json.loads(path.read_text())
    assert path.with_suffix(".md").read_text() == markdown(path.stem, table["cells"], table["searches"])
    for cell in table["cells"]:
        for what, of in COUNTED:
            exact = clopper_pearson(cell[what], cell[of])
            assert cell[f"{what}_interval"] == (exact if exact is None else pytest.approx(exact)), (cell["arena"], what)
        low, high = cell["interventions_interval"]
        assert low <= cell["interventions"] / cell["steps"] <= high and high > 0.0


def test_the_page_of_campaigns_has_the_figures_of_the_ten_thousand_episodes() -> None:
    page = table_rows("docs/campaigns.md", "| arena | episodes | goals | collisions |")
    for table, robot in zip((page[:2], page[2:]), ("ground", "quadrotor"), strict=True):
        cells = stored(f"campaign/{robot}")
        for arena, episodes, goals, collisions, interventions, outside, closest in table:
            cell = cells[arena.strip("`"), "trained", "as-recorded"]
            assert f"{cell['episodes']:,}" == episodes and says(goals, share(cell, "goals", "episodes"))
            assert says(collisions, share(cell, "collisions", "episodes"))
            assert says(interventions, share(cell, "interventions", "steps"))
            counts = [cell["violations"], cell["compared"]]
            assert says(outside, counts if " of " in outside else share(cell, "violations", "compared"))
            assert says(closest, [1e3 * cell["closest"]])


def test_the_page_of_campaigns_has_the_figures_of_changed_robots() -> None:
    ground = stored("campaign_changed/ground")
    air = stored("campaign_changed/quadrotor", "campaign_changed_untrained/quadrotor")
    perturbations: list[str] = []
    policy, tied = "", 0
    for first, figure, *texts in table_rows("docs/campaigns.md", "| policy | figure |", heads=True):
        if first == "policy":
            perturbations = [text.strip("`") for text in texts]
            continue
        policy = first or policy
        for perturbation, text in zip(perturbations, texts, strict=True):
            cell = (air if "wind" in perturbations else ground)["default", policy, perturbation]
            values = {
                "goals": share(cell, "goals", "episodes"),
                "interventions": share(cell, "interventions", "steps"),
                "steps outside their set": share(cell, "violations", "compared"),
                "closest": [1e3 * cell["closest"]],
            }
            assert says(text, values[figure]), (policy, perturbation, figure, text)
            tied += 1
    assert tied == 80


def test_the_page_of_scans_has_the_stored_figures() -> None:
    walkers, tracks = stored("campaign_walkers/ground"), stored("campaign_walkers/ground+tracks")
    unfiltered, scans = stored("campaign_walkers_unfiltered/ground+tracks"), stored("campaign_scans/ground")
    faulty = stored("campaign_scans_faulty/ground")
    for label, *row in table_rows("docs/results_scans.md", "| arena, policy | episodes |"):
        arena, policy, *more = (part.strip("` ") for part in label.split(","))
        touched = "walkers" in arena
        if policy.startswith("the same"):
            cell = unfiltered[arena, "trained", "as-recorded"]
        elif touched:
            cell = (tracks if more else walkers)[arena, policy, "as-recorded"]
        else:
            cell = (faulty if more else scans)[arena, policy, "faulty-scan" if more else "scan"]
        corrected = "–" if cell["model_set"] == "none" else f"{100 * cell['interventions'] / cell['steps']:.1f} %"
        counts = [f"{cell['episodes']}", str(cell["collisions"])]
        counts += [str(cell["contacts_standing"])] * touched + [str(cell["goals"]), corrected]
        assert row == [*counts, *[str(cell["violations"])] * (not touched), f"{cell['steps']:,}"], label
    cells = [cell for table in (walkers, tracks, scans, faulty) for cell in table.values()]
    steps, outside, episodes = (sum(cell[name] for cell in cells) for name in ("compared", "violations", "episodes"))
    text = " ".join((ROOT / "docs/results_scans.md").read_text().split())
    assert f"0 collisions in {steps:,} filtered steps ({episodes:,} episodes)" in text
    assert f"After {outside} of these steps" in text and not any(cell["collisions"] for cell in cells)
