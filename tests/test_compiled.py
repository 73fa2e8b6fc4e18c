"""What the loops that numba compiles owe to the promise of one seed, one path."""

import importlib
import os
import pkgutil
import subprocess
import sys

import pytest
from numba.core.registry import CPUDispatcher

import controllers
import scenes
import terrains
import twin


def compiled_functions():
    found = {}
    for package in (twin, scenes, controllers, terrains):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not module.name.endswith("__main__"):
                members = vars(importlib.import_module(module.name)).values()
                found |= {id(member): member for member in members if isinstance(member, CPUDispatcher)}
    return list(found.values())


def name_of(function):
    return f"{function.py_func.__module__}.{function.py_func.__name__}"


def free_sums(functions):
    """Those whose sums may take any order: for each, whether it is part of who calls it, and who does."""
    for function in functions:
        options, name = function.targetoptions, function.py_func.__name__
        if options.get("fastmath"):
            inlined = options.get("forceinline", False) or options.get("inline") == "always"
            others = [f for f in functions if name in f.py_func.__code__.co_names and f is not function]
            yield name_of(function), inlined, [name_of(other) for other in others]


def test_sums_in_free_order_are_part_of_who_calls_them():
    """Where fastmath leaves the order of a sum open, each copy of a function may take another.

    A function that others call is compiled by itself and again into each of them. Which copy a call reaches is whose
    code was loaded first: in the process that compiles another than in those that read the cache, and images differed
    in the last bit, paths by 0.6 mm. Put into its callers it has no copy to be mistaken for.
    """
    found = {name: (inlined, callers) for name, inlined, callers in free_sums(compiled_functions())}
    assert found["twin.imaging.shading._shine"] == (True, ["twin.imaging.shading.shade"])
    assert found["twin.imaging.shading.shade"] == (False, [])
    wrong = [name for name, (inlined, callers) in found.items() if callers and not inlined]
    assert not wrong, f"want forceinline=True, as others call them: {', '.join(wrong)}"


@pytest.mark.slow
def test_the_run_that_compiles_flies_the_same_path(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "MUJOCO_GL": "egl"}
    small = ["--set", "plan.tracks=1", "--set", "plan.area_m=[2.4, 1.2]"]
    for name in ("compiles", "reads"):
        line = [sys.executable, "-m", "twin", "run", "quickstart", *small, "--out", str(tmp_path / name)]
        subprocess.run(line, env=environment, check=True, stdout=subprocess.DEVNULL)
    for file in ("trajectory_truth.tum", "trajectory_f2f.tum", "trajectory_final.tum", "dem.tif"):
        assert (tmp_path / "compiles" / file).read_bytes() == (tmp_path / "reads" / file).read_bytes(), file
