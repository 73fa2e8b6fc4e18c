"""Camera rigs as files: cameras, sensor, lens, port, residual calibration error and lamps of a published or own rig."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from twin.core.user_files import is_file, resolved
from twin.errors import TwinError
from twin.scenario.model import (
    CalibrationErrorConfig,
    LampConfig,
    LensConfig,
    PortConfig,
    RigConfig,
    Section,
    SensorConfig,
)

#: Sections of a scenario that a rig replaces as a whole; its lamps, if it has any, replace those of the scenario too.
REPLACED = ("rig", "sensor", "lens", "port", "calibration_error")


class RigFile(Section):
    """Contents of a rig file: sections of a scenario, and where their numbers come from."""

    title: str = Field(min_length=1, max_length=80)
    sources: dict[str, str]
    """source of each section or key, e.g. "sensor.read_noise_e"; "not published" for an assumption"""
    rig: RigConfig
    sensor: SensorConfig | None = None
    lens: LensConfig = LensConfig()
    port: PortConfig = PortConfig()
    calibration_error: CalibrationErrorConfig = CalibrationErrorConfig()
    lamps: tuple[LampConfig, ...] | None = None


def built_in_rigs() -> dict[str, Path]:
    """Returns the rig files in scenes/rigs/ by name, in alphabetical order."""
    from twin import scenes

    return {file.stem: file for file in sorted((Path(scenes.__file__).parent / "rigs").glob("*.toml"))}


def find_rig(model: str, folder: Path) -> Path:
    """Returns the rig file of a name in scenes/rigs/, or of a path relative to a folder.

    Raises:
        TwinError: there is neither a rig of this name nor a file.
    """
    if model in (rigs := built_in_rigs()):
        return rigs[model]
    if is_file(file := resolved(folder / model)):
        return file
    raise TwinError("rig.model", f"{model!r}: no such rig", f"a file, or one of {', '.join(rigs)}")


def sections_of(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the sections that a rig file, with these keys and values, sets in a scenario."""
    sections = {key: tree[key] for key in (*REPLACED, "lamps") if key in tree}
    return sections | {"rig": {**tree["rig"], "title": tree["title"]}}
