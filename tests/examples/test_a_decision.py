"""examples/a_decision.ipynb: its cells, run one after the other."""

import json
from pathlib import Path

import matplotlib

NOTEBOOK = Path(__file__).parents[2] / "examples" / "a_decision.ipynb"


def test_the_notebook_runs_from_top_to_bottom(data_folder, capsys):
    matplotlib.use("Agg")
    names: dict[str, object] = {}
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    printed = capsys.readouterr().out
    assert "0.60 m: allowed" in printed
    assert "0.25 m: adjusted" in printed
    assert "0.21 m: failsafe" in printed
    assert len(names["axes"]) == 3
