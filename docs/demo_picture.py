"""Picture of the demo for the README: `python docs/demo_picture.py RUN_FOLDER PICTURE.jpg`.

The picture shows the estimated surface from the south, a left image, and the orthomosaic of a survey that `twin demo`
has flown.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio

from twin.report.images import read_rgb
from twin.report.mesh_picture import surface_picture


def orthomosaic(file: Path) -> np.ndarray:
    """Returns the orthomosaic (h, w, 4) RGBA, cropped to its opaque pixels."""
    with rasterio.open(file) as raster:
        bands = np.moveaxis(raster.read(), 0, -1)
    rows, cols = np.nonzero(bands[..., 3])
    return bands[rows.min() : rows.max() + 1, cols.min() : cols.max() + 1]


def main(folder: Path, picture: Path) -> None:
    """Writes a picture (PNG or JPEG) with three views of a run.

    Args:
        folder: the run folder.
        picture: file to write.
    """
    lefts = sorted((folder / "keyframes").glob("*_left.png"))
    views = {
        "Estimated surface": surface_picture(folder / "mesh.glb"),
        "Image of the left camera": read_rgb(lefts[2 * len(lefts) // 5]),
        "Orthomosaic, without the effects of water and lamps": orthomosaic(folder / "mosaic.tif"),
    }
    figure = plt.figure(figsize=(12, 9.6), layout="constrained")
    grid = figure.add_gridspec(2, 5, height_ratios=[1.75, 1])
    places = grid[0, :], grid[1, :2], grid[1, 2:]
    for place, (title, view) in zip(places, views.items(), strict=True):
        axes = figure.add_subplot(place)
        axes.set_title(title, fontsize=11)
        axes.axis("off")
        if view is not None:
            axes.imshow(view)
    figure.savefig(picture, dpi=110, facecolor="white", pil_kwargs={"quality": 88} if picture.suffix == ".jpg" else {})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
