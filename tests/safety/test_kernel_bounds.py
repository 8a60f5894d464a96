"""No compiled kernel reads or writes outside its arrays. By default, compiled code does not check indices."""

import os
import subprocess
import sys
from pathlib import Path

from brakeline.safety import compilation

HERE = Path(__file__).resolve().parent
# They call every kernel, with arrays of random sizes and with images of a real sensor's size.
KERNEL_TESTS = ("filter_kernels", "halfspace_kernels", "perception_kernels", "occlusion_kernels")


def test_no_kernel_reads_or_writes_outside_its_arrays(tmp_path):
    """Run the tests of the kernels with checked indices, in an interpreter and with a cache of their own."""
    quick = {"NUMBA_OPT": "1", "NUMBA_LOOP_VECTORIZE": "0", "NUMBA_SLP_VECTORIZE": "0"}  # compile in half the time
    checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(HERE.parents[1])}
    files = [str(HERE / f"test_{name}.py") for name in KERNEL_TESTS]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *files]
    run = subprocess.run(command, env=os.environ | checked | quick, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]


def test_code_that_cannot_be_stored_is_compiled_and_a_warning_says_so_once(monkeypatch, caplog):
    def njit(signature, cache=False, **_):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: function

    compilation._say_that_nothing_is_stored.cache_clear()
    monkeypatch.setattr(compilation, "njit", njit)
    assert [compilation.compiled("f8(f8)")(abs)(-1.0) for _ in range(3)] == [1.0] * 3
    (record,) = caplog.records
    assert "set NUMBA_CACHE_DIR to a folder in which you may write" in record.getMessage()
