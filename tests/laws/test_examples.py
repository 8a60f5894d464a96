"""Law: examples import public names only, so that a reader may copy them."""

import ast
import json
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

EXAMPLES = Path(__file__).parents[2] / "examples"
# What a simulator of your own builds on (docs/your_robot.md), and the entry of the command line.
OPEN_MODULES = {
    "brakeline.deploy.cli",
    "brakeline.sim.arena",
    "brakeline.sim.ground_estimator",
    "brakeline.sim.planar_robot",
    "brakeline.sim.scripted_policies",
    "brakeline.sim.sim_conditions",
    "brakeline.sim.vehicle",
}
# These two measure what a page states. They are not there to be copied.
MEASUREMENTS = {EXAMPLES / "own_log" / "table.py", EXAMPLES / "foreign" / "train.py"}


def code_of(file: Path) -> str:
    """Return a program, or the code cells of a notebook."""
    if file.suffix == ".py":
        return file.read_text()
    cells = json.loads(file.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def private_imports(code: str) -> list[str]:
    """Return the modules of Brakeline that a program imports and that are not public."""
    nodes = list(ast.walk(ast.parse(code)))
    modules = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    modules += [name.name for node in nodes if isinstance(node, ast.Import) for name in node.names]
    return [module for module in modules if module.startswith("brakeline.") and module not in OPEN_MODULES]


FILES = sorted({*EXAMPLES.rglob("*.py"), *EXAMPLES.rglob("*.ipynb")} - MEASUREMENTS)


@pytest.mark.parametrize("file", [file for file in FILES if ".venv" not in file.parts], ids=lambda file: file.name)
def test_an_example_imports_public_names_only(file: Path) -> None:
    assert private_imports(code_of(file)) == []


def test_a_private_import_is_found() -> None:
    code = (
        "from brakeline import Filter\nimport brakeline.sim.vehicle\ndef f():\n    from brakeline.safety.gym import X"
    )
    assert private_imports(code) == ["brakeline.safety.gym"]


def test_the_notebook_holds_its_outputs() -> None:
    cells = json.loads((EXAMPLES / "a_decision.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    kinds = [output["output_type"] for cell in code for output in cell["outputs"]]
    pictures = [output for cell in code for output in cell["outputs"] if "image/png" in output.get("data", {})]
    assert "stream" in kinds and len(pictures) == 1
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
