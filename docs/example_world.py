"""Flies a survey frame by frame with the estimators and the controller of its scenario, like `twin run`.

Usage: python docs/example_world.py FOLDER [SCENE [KEY=VALUE ...]]; writes the true and the estimated trajectories.
"""

import sys
from pathlib import Path

import twin

folder = Path(sys.argv[1])
scenario = twin.load_scenario(sys.argv[2] if len(sys.argv) > 2 else "quickstart", sys.argv[3:])
folder.mkdir(parents=True, exist_ok=True)
with twin.World(scenario) as world:
    frame = world.reset(scenario.seed)
    estimator, pilot, actions = world.estimator(), world.pilot(), world.actions()
    while frame is not None:
        if world.aligns:
            estimator.align_track(world.track)
        estimate = estimator.update(frame, world.track)
        command = pilot(estimate, frame)
        frame = world.step(command, actions(estimate))
    result = estimator.finish()
    world.truth().trajectory.save(folder / "trajectory_truth.tum")
    for name in ("f2f", "online", "final"):
        getattr(result, name).save(folder / f"trajectory_{name}.tum")
