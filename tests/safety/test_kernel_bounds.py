"""No kernel reads or writes outside its arrays. By default, compiled code does not check indices."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from brakeline import compilation

TESTS = Path(__file__).resolve().parents[1]
# They call every kernel, with arrays of random sizes and with images of a real sensor's size.
KERNEL_TESTS = (
    *(f"safety/test_{name}_kernels.py" for name in ("filter", "perception", "occlusion")),
    *(
        f"sim/test_quadrotor.py::test_{name}"
        for name in (
            "the_controller_is_its_twin_bit_for_bit",
            "free_flight_is_that_of_mujoco",
            "a_vehicle_flies_freely_until_it_may_touch_something",
        )
    ),
    *(
        f"sim/test_arenas.py::test_{name}"
        for name in (
            "nearest_distances_are_those_of_the_shapes",
            "without_an_obstacle_the_distance_is_infinite",
            "connected_cells_are_those_of_one_label",
            "the_distance_of_a_point_that_is_not_a_number_is_none",
            "the_first_fitting_outline_is_that_of_the_gaps",
            "gaps_between_outlines_are_exact",
            "an_outline_does_not_fit_over_itself",
        )
    ),
    "sim/test_lidar.py::test_ranges_are_those_of_mujoco",
)
OF_COMPILATION = ("every_kernel_has_a_twin", "refuses_other_types", "prepare_loads_every_kernel")  # no indices in these


def run_kernel_tests(environment, *options):
    """Run the tests of the kernels in another interpreter."""
    files = [str(TESTS / name) for name in KERNEL_TESTS]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *options, *files]
    there = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}  # it is alone
    there |= {"PYTHONPATH": str(TESTS.parent)} | environment
    run = subprocess.run(command, env=there, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]


def test_no_kernel_reads_or_writes_outside_its_arrays():
    """As plain Python, where NumPy checks each index. Python also warns of divisions by zero, which kernels may do."""
    chosen = " and ".join(f"not {name}" for name in OF_COMPILATION)
    run_kernel_tests({"NUMBA_DISABLE_JIT": "1"}, "-k", chosen, "-W", "ignore::RuntimeWarning")


@pytest.mark.long
def test_no_compiled_kernel_reads_or_writes_outside_its_arrays(tmp_path):
    """The same with compiled code that checks each index. Compiling it takes half a minute."""
    quick = {"NUMBA_OPT": "1", "NUMBA_LOOP_VECTORIZE": "0", "NUMBA_SLP_VECTORIZE": "0"}  # compile in half the time
    run_kernel_tests({"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)} | quick)


def test_code_that_cannot_be_stored_is_compiled_and_a_warning_says_so_once(monkeypatch, caplog):
    def njit(signature=None, cache=False, **_):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    compilation._say_that_nothing_is_stored.cache_clear()
    monkeypatch.setattr(compilation, "njit", njit)
    assert [compilation.compiled("f8(f8)")(lambda x: -x)(-1.0) for _ in range(3)] == [1.0] * 3
    (record,) = caplog.records
    assert "set NUMBA_CACHE_DIR to a folder in which you may write" in record.getMessage()


CALLED = """from brakeline.compilation import compiled

@compiled("f8(f8)")
def called(x):
    return {} * x
"""
CALLING = """from brakeline import compilation

compilation.__file__ = {!r}
from called import called

@compilation.compiled("f8(f8)")
def calling(x):
    return called(x)

print(calling(1.0))
"""


def test_stored_code_that_calls_a_kernel_of_another_file_is_compiled_again_after_that_file_changed(tmp_path):
    """Numba compares stored code with its own file alone: after an upgrade, tubes were those of the kernel before."""
    folder = tmp_path / "safety" / "kernels"
    folder.mkdir(parents=True)
    (folder / "calling.py").write_text(CALLING.format(str(tmp_path / "compilation.py")))
    command = [sys.executable, "-B", "calling.py"]  # -B: a .pyc tells no two changes within a second apart
    for factor in ("2.0", "3.0", "3.0"):
        (folder / "called.py").write_text(CALLED.format(factor))
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert float(done.stdout) == float(factor)
    assert (folder / "__pycache__" / compilation.STAMP).exists()
