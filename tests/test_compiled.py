"""Compiled functions give bit-identical results, whether compiled in this process or loaded from the cache."""

import importlib
import os
import pkgutil
import subprocess
import sys

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import twin
from twin import controllers, scenes, terrains


def compiled_functions():
    """Returns all numba-compiled functions of the project."""
    found = {}
    for package in (twin, scenes, controllers, terrains):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not module.name.endswith("__main__"):
                members = vars(importlib.import_module(module.name)).values()
                found |= {id(member): member for member in members if isinstance(member, CPUDispatcher)}
    return list(found.values())


def name_of(function):
    return f"{function.py_func.__module__}.{function.py_func.__name__}"


def fastmath_functions(functions):
    """Yields name, whether it is always inlined, and the callers of each function compiled with fastmath."""
    for function in functions:
        options, name = function.targetoptions, function.py_func.__name__
        if options.get("fastmath"):
            inlined = options.get("forceinline", False) or options.get("inline") == "always"
            others = [f for f in functions if name in f.py_func.__code__.co_names and f is not function]
            yield name_of(function), inlined, [name_of(other) for other in others]


def test_fastmath_functions_that_others_call_are_inlined():
    """With fastmath, the compiler may reorder a sum, differently in each compiled copy of a function.

    A function that others call is compiled once by itself and once into each caller. Which copy a call reaches depends
    on which code was loaded first, so a process that compiles and one that loads from the cache could differ: in the
    last bit of an image and, by its effect on control, by 0.6 mm in a path. An inlined function has no separate copy.
    """
    found = {name: (inlined, callers) for name, inlined, callers in fastmath_functions(compiled_functions())}
    assert found["twin.imaging.light.shading._illuminate"] == (True, ["twin.imaging.light.shading.shade"])
    assert found["twin.imaging.light.shading.shade"] == (False, [])
    wrong = [name for name, (inlined, callers) in found.items() if callers and not inlined]
    assert not wrong, f"called by others, so forceinline=True is required: {', '.join(wrong)}"


IMAGES = """
import sys
import numpy as np
from twin.app.look import render_view
from twin.scenario.file import load_scenario
from twin.world.mission import prepare
view = render_view(prepare(load_scenario("reef")), twist_body=np.array([0.0, 0.0, 0.1, 0.2, 0.0, 0.0]))
layers = [*view.stereo_pair[:4], *view.decomposed.components, view.decomposed.raw]
np.savez(sys.argv[1], *[layer for layer in layers if layer is not None])
"""


def in_both_ways(folder, *arguments):
    """Runs Python twice with an empty cache of kernels in `folder`, with "compiles" and "reads" as last argument."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "MUJOCO_GL": "egl"}
    for name in ("compiles", "reads"):
        line = [sys.executable, *arguments, str(folder / name)]
        subprocess.run(line, env=environment, check=True, stdout=subprocess.DEVNULL)


@pytest.mark.long
def test_images_of_compiled_and_of_loaded_code_are_identical(tmp_path):
    in_both_ways(tmp_path, "-c", IMAGES)
    compiled, read = (np.load(tmp_path / f"{name}.npz") for name in ("compiles", "reads"))
    assert len(compiled.files) > 8
    for name in compiled.files:
        np.testing.assert_array_equal(compiled[name], read[name])


@pytest.mark.slow
def test_a_run_that_compiles_and_one_that_loads_the_cache_write_identical_files(tmp_path):
    in_both_ways(
        tmp_path, "-m", "twin", "run", "reef", "--set", "plan.tracks=1", "--set", "plan.area_m=[2.4, 1.2]", "--out"
    )
    for file in ("trajectory_truth.tum", "trajectory_f2f.tum", "trajectory_final.tum", "dem.tif"):
        assert (tmp_path / "compiles" / file).read_bytes() == (tmp_path / "reads" / file).read_bytes(), file
