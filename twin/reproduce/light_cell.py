"""Light by the light model and by the Monte Carlo reference in one situation: the records of all comparisons."""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.imaging.reference.pixel_light import BatchMean, Effort, Light, refined

GREEN, ALBEDO = 1, 128  # band that is compared, and albedo of the floor; 255 = white
_ROUND, WALKS = 8_000, 1_500_000  # walks (for a pixel: pairs) in a round; most walks for each value


class Compared(NamedTuple):
    """A quantity by the model and by the reference."""

    model: float
    truth: BatchMean
    unit: str = ""  #: end of its keys in the files, such as "_lx"
    keys: tuple[str, ...] = ("model", "truth", "se")  #: the values that the files hold

    @property
    def ratio(self) -> BatchMean:
        """Returns model / truth, with its standard error."""
        value = self.model / self.truth.value
        return BatchMean(value, value * self.truth.standard_error / self.truth.value)

    @property
    def inverse_ratio(self) -> BatchMean:
        """Returns truth / model, with its standard error; NaN if the model is 0."""
        if not self.model:
            return BatchMean(np.nan, np.nan)
        return BatchMean(self.truth.value / self.model, self.truth.standard_error / self.model)

    def over(self, other: "Compared") -> "Compared":
        """Returns the quotient of two quantities, whose truths are independent."""
        value = self.truth.value / other.truth.value
        own, others = (one.truth.standard_error / one.truth.value for one in (self, other))
        return Compared(self.model / other.model, BatchMean(value, float(value * np.hypot(own, others))))

    def row(self, name: str) -> dict[str, float]:
        values = {
            "model": (f"{name}_model{self.unit}", self.model),
            "truth": (f"{name}_truth{self.unit}", self.truth.value),
            "se": (f"{name}_truth_se", self.truth.standard_error),
        }
        return dict(values[key] for key in self.keys)


class LightCell(NamedTuple):
    conditions: dict[str, Any]  #: water type, heights etc. by key in the files
    light: dict[str, Compared]  #: quantities by key


def write_csv(cells: Sequence[LightCell], file: Path) -> list[dict[str, Any]]:
    """Writes cells to a CSV file, in a folder that is created if missing; returns the rows."""
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        cell.conditions | {key: x for name, one in cell.light.items() for key, x in one.row(name).items()}
        for cell in cells
    ]
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return rows


def estimate(light_of: Callable[[Effort], Light], is_accurate: Callable[[Light], bool], walks: int) -> Light:
    """Returns the light by the reference, which takes rounds until it is accurate; `walks` is their largest number."""
    return refined(light_of, is_accurate, Effort(min(walks, _ROUND)), walks)


def within(error: float, *means: BatchMean) -> bool:
    """Returns whether the relative standard error of every mean is at most `error`."""
    return all(mean.standard_error <= error * mean.value for mean in means)


def text_of(mean: BatchMean, digits: str = ".3g") -> str:
    """Returns a mean with its standard error as text; "-" if it is not known."""
    return "-" if np.isnan(mean.value) else f"{mean.value:{digits}} +- {mean.standard_error:.1g}"


def looking_down(height_m: float) -> NDArray[np.float64]:
    """Returns the pose world_from_camera (4, 4) of a camera that points straight down, `height_m` above the origin."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = height_m
    return pose
