"""A study on SLURM jobs, with a real controller and a node on this machine."""

import json
import os
import subprocess
import sys

import pytest
from slurm_machine import MISSING, slurm_machine

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(bool(MISSING) or os.getuid() != 0, reason=f"needs root and {', '.join(MISSING) or 'SLURM'}"),
]

STUDY = """
scenario = "reef"
set = { "imaging.fidelity" = "surrogate", "plan.tracks" = 1, "plan.area_m" = [0.8, 0.8] }
vary = { "plan.altitude_m" = { uniform = [1.8, 2.0] } }
sampling = { samples = 3 }
require = { probability = 0.5, "map.le90_m" = 0.05 }
"""


def test_a_study_runs_on_slurm_jobs(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "slurm").mkdir()
    command = [sys.executable, "-m", "twin", "study", "study.toml", "--scheduler", "slurm", "--jobs", "1", "--json"]
    with slurm_machine(tmp_path / "slurm") as environment:
        flown = subprocess.run(
            [*command, "--out", "out"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )
        assert flown.returncode == 0, flown.stderr
        jobs = (tmp_path / "slurm" / "slurmctld.log").read_text().count("Allocate JobId")
        left = ["squeue", "-h", "--states=PENDING,RUNNING"]
        assert not subprocess.run(left, env=environment, capture_output=True, text=True, check=True).stdout
    assert jobs == 1 and json.loads(flown.stdout)["throughput"]["surveys"] == 3
