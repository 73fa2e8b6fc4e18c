"""Sheet of ten scenes for the README: `python docs/scenes_picture.py PICTURE.jpg`.

It shows the left images of `twin look`. The scanned corals of `horseshoe_corals` are read from `${TWIN_DATA}`.
"""

import sys
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

from twin.app.look import render_view
from twin.reproduce.tank_survey import tank_mission
from twin.scenario.file import load_scenario
from twin.world.mission import Mission, prepare

SIZE = ("rig.image_width_px=960", "rig.image_height_px=720")
DAYLIGHT = ("lamps=[]", "water.jerlov=II", "sun.illuminance_lx=40000", "sun.depth_m=6", "sun.elevation_deg=50")
COLUMNS, WIDTH_PX, HEIGHT_PX = 5, 480, 360

Position = tuple[float, float, float]


def scene(name: str, *settings: str) -> Mission:
    """Returns the mission of a scenario with images of 960 x 720 pixels."""
    return prepare(load_scenario(name, [*SIZE, *settings]))


def missions() -> dict[str, tuple[Mission, Position | None]]:
    """Returns the ten missions and the positions of their left cameras [m] by title; None: centre of the survey."""
    floors = {
        "sand": ("terrain.kind=ripples", "terrain.relief_m=0.06", "terrain.cover=sand"),
        "rubble": ("terrain.cover=rubble",),
        "rock": ("terrain.kind=fractal", "terrain.relief_m=0.8", "terrain.cover=rock"),
        "seagrass": ("terrain.cover=seagrass",),
        "mud": ("terrain.kind=fractal", "terrain.relief_m=0.2", "terrain.cover=mud"),
    }
    return {
        **{f"terrain.cover = {name}": (scene("reef", *settings), None) for name, settings in floors.items()},
        "quickstart": (scene("quickstart"), (0.3, 0.1, 2.2)),
        "reef in daylight, 6 m deep, Jerlov II": (
            scene("reef", *DAYLIGHT, "terrain.cover=coral"),
            None,
        ),
        "coral_garden": (scene("coral_garden"), None),
        "horseshoe_corals, scanned reef and corals": (scene("horseshoe_corals"), (1.0, 0.6, 2.4)),
        "tank of the paper": (tank_mission(SIZE), (0.1, 0.0, 1.524)),
    }


def main(picture: Path) -> None:
    """Writes the sheet (PNG or JPEG)."""
    shown = missions()
    rows = -(-len(shown) // COLUMNS)
    figure, grid = plt.subplots(rows, COLUMNS, figsize=(COLUMNS * 4.8, rows * 3.9), layout="constrained", squeeze=False)
    for axes, (title, (mission, at_m)) in zip(grid.ravel(), shown.items(), strict=True):
        left = render_view(mission, at_m).stereo_pair.left
        axes.imshow(cv2.resize(np.asarray(left), (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA))
        axes.set_title(title, fontsize=12, loc="left")
        axes.set_axis_off()
    figure.savefig(picture, dpi=100, facecolor="white", pil_kwargs={"quality": 88} if picture.suffix == ".jpg" else {})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
