"""Kills runs, replays, studies and searches at random moments, resumes them, and compares every byte of the results.

usage: python tests/kill_and_resume.py FOLDER [--run 20] [--replay 10] [--study 5] [--tune 5] [--seed 1]

Each command first runs undisturbed. It is then started again and killed (SIGKILL, with its workers) at a moment that is
uniformly distributed over this time, resumed, killed once more in every third case, and resumed to its end. The files
must be those of the undisturbed one, except run times. The table lists each kill with its moment, what the killed
folder held, and the files that differ. Ends with status 1 if any does.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

CHECKPOINT_S = "0.5"
SMALL = [
    "--set=terrain.size_m=[5.0,4.0]", "--set=rig.image_width_px=192", "--set=rig.image_height_px=144",
    "--set=rig.frame_rate_hz=15", "--set=plan.area_m=[0.8,0.5]", "--set=plan.altitude_m=1.8",
    "--set=control.hold_s=0.4",
]  # fmt: skip
STUDY = """
scenario = "reef"
[set]
imaging.fidelity = "surrogate"
plan.area_m = [1.0, 0.6]
[vary]
water.turbidity = { uniform = [1.0, 2.0] }
[sampling]
samples = 6
[require]
probability = 0.5
"map.le90_m" = 0.02
"""
TUNE = (
    STUDY
    + """
[tune]
objectives = ["timing.simulated_s", "map.le90_m"]
trials = 6
batch = 3
verify = 0
[tune.search]
plan.altitude_m = { uniform = [1.7, 2.3] }
"""
)
#: Keys of JSON files that hold run times.
TIMES = ("timing", "timing_ms", "ga_ms", "ms", "lasted_s")
COMPARED = (".tum", ".tif", ".g2o", ".glb", ".csv", ".npz", ".png", ".json", ".jsonl", ".toml", ".parquet")


def without_times(value):
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in TIMES and not k.startswith("timing.")}
    return [without_times(one) for one in value] if isinstance(value, list) else value


def contents(file):
    """Returns what must be equal in a file: its bytes, or those of its values that are no run times."""
    if file.suffix == ".json":
        return without_times(json.loads(file.read_text()))
    if file.suffix == ".jsonl":
        rows = [without_times(json.loads(line)) for line in file.read_text().splitlines()]
        return sorted(rows, key=lambda row: (row.get("sample", 0), row.get("seed", 0))) if "rows" in file.name else rows
    if file.suffix == ".parquet":
        return without_times(pq.read_table(file).to_pydict())
    return file.read_bytes()


def differences(expected, found):
    """Returns the names of the result files that are not equal in two folders, or exist in one of them only."""
    files = [{p.relative_to(f) for p in f.rglob("*") if p.suffix in COMPARED} for f in (expected, found)]
    names = sorted(name for name in files[0] | files[1] if name.name != "env.json")
    return [
        str(name)
        for name in names
        if name not in files[0] & files[1] or contents(expected / name) != contents(found / name)
    ]


def leftovers(folder):
    """Returns what only a run in progress has."""
    names = (".lock", ".reserve", "checkpoint", "*.part", ".*.part", "*_disparity.npy")
    return [str(file.relative_to(folder)) for name in names for file in folder.rglob(name)]


def start(arguments, log):
    command = [sys.executable, "-m", "twin", *map(str, arguments)]
    return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def finish(arguments, log):
    """Runs a command to its end; returns its duration [s] and its status."""
    begin = time.perf_counter()
    status = start(arguments, log).wait()
    return time.perf_counter() - begin, status


def kill_after(arguments, wait_s, log):
    """Kills a command and its workers after a time; returns whether it was still running."""
    process = start(arguments, log)
    try:
        process.wait(wait_s)
        return False
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True


def held(folder):
    """Returns how far a killed command had come, by its files."""
    manifest = folder / "checkpoint" / "manifest.json"
    if manifest.is_file():
        state = json.loads(manifest.read_text())["state"]
        return "no state" if state is None else f"state {state['number']}"
    rows = folder / "rows.jsonl"
    return f"{len(rows.read_text().splitlines())} rows" if rows.exists() else "nothing" if not folder.exists() else "-"


def kill_and_resume(name, arguments, n, folder, rng):
    """Returns the number of kills after which the results differ."""
    expected, failed = folder / f"{name}-undisturbed", 0
    shutil.rmtree(expected, ignore_errors=True)
    with (folder / f"{name}.log").open("w") as log:
        whole_s, status = finish([*arguments, "--out", expected], log)
        for k in range(n):
            out = folder / f"{name}-killed"
            shutil.rmtree(out, ignore_errors=True)
            moment, resumed = rng.uniform(0.0, 1.0), [*arguments, "--out", out, "--resume"]
            was_running = kill_after([*arguments, "--out", out], moment * whole_s, log)
            state = held(out)
            if k % 3 == 0:
                was_running |= kill_after(resumed, rng.uniform(0.0, 1.0) * whole_s, log)
                state += f", {held(out)}"
            again_s, again = finish(resumed, log)
            wrong = differences(expected, out) + leftovers(out) + ([] if again == status else [f"status {again}"])
            failed += bool(wrong)
            verdict = "identical" if not wrong else f"DIFFERS: {', '.join(wrong[:5])}"
            ended = "" if was_running else " (had ended)"
            print(f"{name:7} {k + 1:3} {moment:5.2f} {state:22} {again_s:6.1f} s  {verdict}{ended}", flush=True)
    return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    for name, n in (("run", 20), ("replay", 10), ("study", 5), ("tune", 5)):
        parser.add_argument(f"--{name}", type=int, default=n, help="number of kills")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    folder, rng, failed = options.folder, np.random.default_rng(options.seed), 0
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints = ["--checkpoint-s", CHECKPOINT_S]
    if options.run:
        failed += kill_and_resume("run", ["run", "reef", *SMALL, *checkpoints], options.run, folder, rng)
    if options.replay:
        data = folder / "recorded"
        if not (data / "export").exists():
            with (folder / "recorded.log").open("w") as log:
                shutil.rmtree(data, ignore_errors=True)
                finish(["run", "reef", *SMALL, "--set=record=all", "--out", data], log)
                finish(["export", data, "--to", "euroc"], log)
        replay = ["replay", data / "export" / "euroc", *checkpoints]
        failed += kill_and_resume("replay", replay, options.replay, folder, rng)
    for name, text, n in (("study", STUDY, options.study), ("tune", TUNE, options.tune)):
        if n:
            (folder / f"{name}.toml").write_text(text)
            failed += kill_and_resume(name, [name, folder / f"{name}.toml", "--jobs", 1], n, folder, rng)
    print(f"{failed} kills changed a result")
    return failed > 0


if __name__ == "__main__":
    sys.exit(main())
