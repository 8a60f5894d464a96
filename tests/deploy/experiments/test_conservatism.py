"""The certificates' table: what was driven, what was refused, and what is too wide to drive."""

from brakeline.deploy.experiments import conservatism
from brakeline.deploy.experiments.conservatism import Conservatism
from brakeline.deploy.experiments.experiment_jobs import configuration

SAID = {"half_width_rest": 0.0056, "half_width_full": 0.0081, "violations": 2, "windows": 1981, "bound_plan": 0.0042}


def drove(goals):
    return {
        "goals": goals,
        "collisions": 0,
        "interventions": 0.05,
        "steps": 900,
        "decision_ms": {"mean": 0.2, "std": 0},
    }


def test_every_kind_of_row_has_all_columns():
    rows = [
        {
            "certificate": "residual",
            "mode": "direct",
            "statement": SAID,
            "driving": {"astar": drove(60), "x": drove(7)},
        },
        {"certificate": "residual", "mode": "recursion", "statement": SAID | {"half_width_full": 3e5}, "driving": None},
        {"certificate": "matrix-zonotope", "mode": "recursion", "refused": "poor data"},
    ]
    study = configuration(Conservatism("ground", policies=("astar", "x")))
    lines = conservatism.markdown({"study": study, "rows": rows}).splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1 and len(table) == 5
    assert "| 5.6 mm | 8.1 mm | 2 of 1981 | 0.42% | 60, 5.0% | 7, 5.0% |" in table[2]
    assert "3e+05 m" in table[3] and "not driven" in table[3] and "refused: poor data" in table[4]
