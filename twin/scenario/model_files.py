"""Rigs, vehicles, sets of navigation sensors as files: published or own numbers, and their sources."""

from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from twin.core.user_files import is_file, resolved
from twin.errors import TwinError, did_you_mean
from twin.scenario.model import (
    CalibrationErrorConfig,
    ImuConfig,
    LampConfig,
    LensConfig,
    NavigationConfig,
    PortConfig,
    RigConfig,
    Section,
    SensorConfig,
    VehicleConfig,
)


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


class VehicleFile(Section):
    """Contents of a vehicle file: the section of a scenario, and where its numbers come from."""

    title: str = Field(min_length=1, max_length=80)
    sources: dict[str, str]
    """source of each key, e.g. "added_mass"; "not published" for an assumption"""
    vehicle: VehicleConfig


class NavigationFile(Section):
    """Contents of a file of navigation sensors: sections of a scenario, and where their numbers come from."""

    title: str = Field(min_length=1, max_length=80)
    sources: dict[str, str]
    """source of each key, e.g. "dvl_sigma_mps"; "not published" for an assumption"""
    navigation: NavigationConfig
    imu: ImuConfig | None = None


def built_in(folder: str = "") -> dict[str, Path]:
    """Returns the TOML files in scenes/, or in a folder of it, by name, in alphabetical order."""
    from twin import scenes

    return {file.stem: file for file in sorted((Path(scenes.__file__).parent / folder).glob("*.toml"))}


class ModelKind(NamedTuple):
    """What a file of scenes/ can describe: `name`.model is the key that names it."""

    name: str
    contents: type[Section]
    replaced: tuple[str, ...]  #: sections of a scenario that it replaces as a whole
    optional: tuple[str, ...] = ()  #: sections that it replaces if it has them

    @property
    def key(self) -> str:
        return f"{self.name}.model"

    def find(self, model: str, folder: Path) -> Path:
        """Returns the file of a built-in name, or of a path relative to a folder; raises TwinError if there is none."""
        if model in (files := built_in(f"{self.name}s")):
            return files[model]
        if is_file(file := resolved(folder / model)):
            return file
        hint = did_you_mean(model, list(files))
        raise TwinError(self.key, f"{model!r}: no such {self.name}{hint}", f"a file, or one of {', '.join(files)}")


RIG = ModelKind("rig", RigFile, ("rig", "sensor", "lens", "port", "calibration_error"), ("lamps",))
VEHICLE = ModelKind("vehicle", VehicleFile, ("vehicle",))
NAVIGATION = ModelKind("navigation", NavigationFile, ("navigation",), ("imu",))
KINDS = (RIG, VEHICLE, NAVIGATION)
