"""Linear algebra runs on one thread while the estimators exist, and as before afterwards."""

import os
import subprocess
import sys

CODE = """
from threadpoolctl import threadpool_info
from twin.estimate import Navigator, StereoRig

def threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

assert threads() == {2}, threads()
with Navigator(StereoRig(width_px=64, height_px=48, focal_px=50.0, baseline_m=0.1, frame_rate_hz=5.0)):
    assert threads() == {1}, threads()
assert threads() == {2}, threads()
"""


def test_the_estimators_use_one_thread_and_restore_the_setting_of_their_caller():
    variables = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", CODE], env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
