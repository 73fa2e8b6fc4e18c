"""The MuJoCo model has the mass of the vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from twin.scenes.builder import build
from twin.scenes.gl import mujoco


def test_the_vehicle_has_the_given_mass_and_inertia_and_falls_freely() -> None:
    model = build(0.004, 13.5, (0.26, 0.23, 0.37))
    body = model.body("vehicle").id
    assert model.body_mass[body] == 13.5 and model.body_mass.sum() == 13.5
    assert model.body_inertia[body] == pytest.approx([0.26, 0.23, 0.37])
    assert model.body_ipos[body] == pytest.approx(np.zeros(3))
    assert model.body_iquat[body] == pytest.approx([1, 0, 0, 0])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0 and data.qacc[:3] == pytest.approx([0, 0, -9.81]) and model.opt.timestep == 0.004
