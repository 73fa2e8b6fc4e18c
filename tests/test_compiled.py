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


FUNCTIONS = compiled_functions()
FREE = [function for function in FUNCTIONS if function.targetoptions.get("fastmath")]


def name_of(function):
    return f"{function.py_func.__module__}.{function.py_func.__name__}"


def callers(function):
    """Names of the compiled functions that call this one."""
    name = function.py_func.__name__
    return [name_of(other) for other in FUNCTIONS if name in other.py_func.__code__.co_names and other is not function]


@pytest.mark.parametrize("function", FREE, ids=name_of)
def test_sums_in_free_order_are_part_of_who_calls_them(function):
    """Where fastmath leaves the order of a sum open, each copy of a function may take another.

    A function that others call is compiled by itself and again into each of them. Which copy a call reaches is whose
    code was loaded first: in the process that compiles another than in those that read the cache, and images differed
    in the last bit, paths by 0.6 mm. Put into its callers it has no copy to be mistaken for.
    """
    options = function.targetoptions
    inlined = options.get("forceinline") or options.get("inline") == "always"
    assert inlined or not callers(function), f"{name_of(function)} wants forceinline=True: {callers(function)} call it"


def test_functions_with_sums_in_free_order_are_found_with_their_callers():
    assert {name_of(function) for function in FREE} >= {"twin.imaging.shading.shade", "twin.imaging.shading._shine"}
    shine = next(function for function in FREE if function.py_func.__name__ == "_shine")
    assert callers(shine) == ["twin.imaging.shading.shade"]


@pytest.mark.slow
def test_the_run_that_compiles_flies_the_same_path(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "MUJOCO_GL": "egl"}
    small = ["--set", "plan.tracks=1", "--set", "plan.area_m=[2.4, 1.2]"]
    for name in ("compiles", "reads"):
        line = [sys.executable, "-m", "twin", "run", "quickstart", *small, "--out", str(tmp_path / name)]
        subprocess.run(line, env=environment, check=True, stdout=subprocess.DEVNULL)
    for file in ("trajectory_truth.tum", "trajectory_f2f.tum", "trajectory_final.tum", "dem.tif"):
        assert (tmp_path / "compiles" / file).read_bytes() == (tmp_path / "reads" / file).read_bytes(), file
