"""A survey has the same bytes of trajectories and map whatever the threads, the processors and the BLAS kernels."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SMALL = ("plan.tracks=1", "plan.area_m=[0.8,0.8]", "control.hold_s=0.5")
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
OTHER_KERNELS = {"OPENBLAS_CORETYPE": "Prescott"}


def results(folder, fidelity, variables, processors):
    """Returns the bytes of trajectories, network and map of a survey in a process of its own."""
    keys = [word for key in (*SMALL, f"imaging.fidelity={fidelity}") for word in ("--set", key)]
    subprocess.run(
        [sys.executable, "-m", "twin", "run", "reef", *keys, "--out", str(folder), "--json"],
        cwd=ROOT, env=os.environ | variables, stdout=subprocess.DEVNULL, check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, processors),
    )  # fmt: skip
    files = [*folder.glob("trajectory_*.tum"), *folder.glob("dem*.tif"), *folder.glob("*.g2o")]
    assert len(files) >= 9
    return {file.name: file.read_bytes() for file in files}


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
@pytest.mark.parametrize("fidelity", ["surrogate", "rendered"])
def test_bytes_depend_neither_on_threads_nor_on_processors_nor_on_blas_kernels(tmp_path, fidelity):
    every = os.sched_getaffinity(0)
    first = results(tmp_path / "first", fidelity, {}, every)
    second = results(tmp_path / "second", fidelity, ONE_THREAD | OTHER_KERNELS, {min(every)})
    assert [name for name in first if first[name] != second[name]] == []


def test_numpy_is_not_imported_before_the_command_line_sets_up_openblas():
    code = "import sys, twin.cli; assert 'numpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
