"""The scenario: TOML read into frozen models; all faults told at once, each with file and line."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from twin import geometry
from twin.errors import ScenarioError, TwinError
from twin.records import SensorNoise, StereoRig

JERLOV = Literal["clear", "I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"]
AIDING = Literal["pressure", "ahrs"]
Vector3 = tuple[float, float, float]
Metres = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _numbers_are_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        """A text or a truth value is no number, even where it could be read as one."""
        kind = cls.model_fields[info.field_name or ""].annotation
        if kind in (float, int) and isinstance(value, str | bool):
            raise PydanticCustomError("float_type" if kind is float else "int_type", "a number")
        return value


class Terrain(Section):
    """The sea floor."""

    kind: Literal["flat", "ripples", "fractal", "reef", "file"] = Field(
        default="reef", description="generator, or a real DEM"
    )
    size_m: tuple[Metres, Metres] = Field(
        default=(10.0, 10.0), description="extent along x and y [m], centred at the origin"
    )
    relief_m: float = Field(default=0.6, ge=0, le=20, description="highest minus lowest point of a generated floor [m]")
    base_m: float = Field(
        default=0.0, ge=-50, le=50, description="height of the lowest point above the reference plane [m]"
    )
    grid_m: float = Field(default=0.05, gt=0.001, le=1, description="spacing of a generated height grid [m]")
    height_file: str | None = Field(
        default=None, description="DEM: GeoTIFF, 16-bit PNG or .npy [m]; ${TWIN_DATA} is expanded"
    )
    height_spacing_m: float = Field(
        default=0.01, gt=0, le=10, description="grid spacing of a PNG or .npy height file [m]"
    )
    height_range_m: float = Field(
        default=1.0, gt=0, le=1000, description="height of a PNG's full white over full black [m]"
    )
    texture_file: str | None = Field(
        default=None, description="any image, tiled over the floor; generated where missing"
    )
    texture_px_m: float = Field(default=0.005, gt=0.0005, le=1, description="size of a texture pixel on the floor [m]")


class Vehicle(Section):
    """BlueROV2 Heavy (von Benzon et al. 2022, Table A1); drag factors let a study vary it."""

    buoyancy_n: float = Field(
        default=1.0, ge=-20, le=20, description="net buoyancy after trimming, positive floats [N]"
    )
    drag_factor: float = Field(default=1.0, ge=0.05, le=20, description="scales linear and quadratic drag")
    added_mass_factor: float = Field(default=1.0, ge=0, le=5, description="scales the added mass")


class Rig(Section):
    """The calibrated stereo pair, looking down, the top of the image towards the bow."""

    image_width_px: int = Field(default=320, ge=64, le=2048)
    image_height_px: int = Field(default=240, ge=48, le=2048)
    hfov_deg: float = Field(default=60.0, gt=5, lt=150, description="horizontal field of view in water [deg]")
    baseline_m: float = Field(default=0.15, gt=0.005, le=3, description="distance between the cameras [m]")
    frame_rate_hz: float = Field(default=30.0, ge=1, le=120)
    mount_m: Vector3 = Field(
        default=(0.0, 0.0, -0.15), description="middle of the pair in the body: forward, left, up [m]"
    )


class Imaging(Section):
    """How light becomes numbers."""

    fidelity: Literal["rendered"] = Field(default="rendered", description="images are rendered")
    gray_level: float = Field(
        default=0.45, gt=0.01, lt=1, description="mean image level that auto-exposure aims at (0 to 1)"
    )
    noise_sd: float = Field(default=0.008, ge=0, le=0.5, description="read noise, as a share of full scale")
    shot_noise: float = Field(
        default=0.006, ge=0, le=0.5, description="shot noise at full scale, grows with the root of signal"
    )


class Water(Section):
    """Inherent optical properties of the water."""

    jerlov: JERLOV = Field(default="IB", description="Jerlov water type, or clear (no attenuation, no scattering)")
    turbidity: float = Field(default=1.0, ge=0, le=100, description="multiplies scattering")


class Lamp(Section):
    """A lamp on the vehicle."""

    position_m: Vector3 = Field(description="in the body: forward, left, up [m]")
    tilt_deg: float = Field(
        default=0.0, ge=-90, le=90, description="beam axis from straight down towards the bow [deg]"
    )
    pan_deg: float = Field(default=0.0, ge=-90, le=90, description="beam axis from straight down towards port [deg]")
    intensity_cd: float = Field(default=1000.0, ge=0, le=1e6, description="luminous intensity on the axis [cd]")


class Sun(Section):
    """Even daylight on the floor."""

    illuminance_lx: float = Field(default=0.0, ge=0, le=2e5, description="white daylight on the floor [lx]")


class Current(Section):
    """Steady, irrotational current."""

    velocity_mps: Vector3 = Field(default=(0.0, 0.0, 0.0), description="east, north, up [m/s]")


class Navigation(Section):
    """Navigation sensors: all are simulated; only those in `aiding` reach the estimators."""

    aiding: tuple[AIDING, ...] = Field(default=(), description="sensors that aid vision; empty = vision only")
    pressure_sigma_m: float = Field(default=0.01, gt=0, le=10, description="noise of height by pressure [m]")
    attitude_sigma_deg: float = Field(default=0.2, gt=0, le=30, description="noise of roll and pitch [deg]")
    heading_sigma_deg: float = Field(default=0.5, gt=0, le=90, description="noise of heading [deg]")


class Plan(Section):
    """The lawnmower survey (Negahdaripour & Madjidi 2003, section III-A)."""

    pattern: Literal["lawnmower"] = "lawnmower"
    area_m: tuple[Metres, Metres] = Field(
        default=(4.0, 2.0), description="extent along x (the legs) and y, centred [m]"
    )
    altitude_m: float = Field(
        default=2.2, gt=0, le=100, description="height of the cameras above the reference plane z = 0 [m]"
    )
    speed_mps: float = Field(default=0.25, gt=0.01, le=2, description="speed along the legs [m/s]")
    overlap_along: float = Field(default=0.9, gt=0, lt=1, description="overlap of consecutive key points")
    overlap_across: float = Field(default=0.8, gt=0, lt=1, description="overlap of neighbouring swaths")
    tracks: int = Field(default=0, ge=0, le=1000, description="tracks to fly (two legs each); 0 fills the area")
    clearance_m: float = Field(default=0.3, ge=0, le=10, description="least distance of the cameras to the floor [m]")


class Control(Section):
    """Trajectory following and station keeping."""

    hold_s: float = Field(
        default=2.0, ge=0.1, le=600, description="station keeping at the end of a track, while GA runs [s]"
    )
    natural_frequency_radps: float = Field(default=1.2, gt=0.05, le=10, description="closed-loop bandwidth [rad/s]")


class Estimation(Section):
    """F2F, F2M, the key-point network and global alignment."""

    window_tracks: int = Field(
        default=4, ge=0, le=1000, description="previous tracks in the window of global alignment"
    )
    node_stride: int = Field(default=1, ge=1, le=20, description="every n-th key point is a node of the network")
    min_overlap: float = Field(default=0.45, gt=0, lt=1, description="least true overlap of linked nodes")
    max_links: int = Field(default=7, ge=1, le=50, description="most links of a node to earlier ones")
    use_f2m: bool = Field(
        default=True, description="correct the position at key points by registration with the mosaic"
    )
    use_ga: bool = Field(default=True, description="global alignment at the end of each track and of the survey")
    points: int = Field(default=300, ge=30, le=5000, description="matched points per frame")
    patch_px: int = Field(default=21, ge=7, le=61, description="window of matching, one for stereo and flow alike [px]")


class Mapping(Section):
    """The Kalman depth map and its composition."""

    cell_m: float = Field(default=0.02, gt=0.001, le=1, description="cell of the elevation map [m]")


class Source(BaseModel):
    """Where a scenario came from, so that a fault found later can still be told with file and line."""

    path: Path
    lines: dict[str, int] = {}
    overrides: tuple[str, ...] = ()

    def fault(self, error: TwinError) -> str:
        """`FILE:LINE: key: what is wrong (allowed: ...)`; the line is of the nearest enclosing key that is there."""
        if any(o.split("=", 1)[0].strip().replace('"', "") == error.field for o in self.overrides):
            return f"--set: {error}"
        key = error.field
        while key not in self.lines and "." in key:
            key = key.rpartition(".")[0]
        return f"{self.path}:{self.lines.get(key, 1)}: {error}"


class Scenario(Section):
    """One survey, fully described."""

    name: str = Field(default="survey", min_length=1, max_length=80)
    seed: int = Field(default=0, ge=0, lt=2**32)
    terrain: Terrain = Terrain()
    vehicle: Vehicle = Vehicle()
    rig: Rig = Rig()
    imaging: Imaging = Imaging()
    water: Water = Water()
    lamps: tuple[Lamp, ...] = ()
    sun: Sun = Sun()
    current: Current = Current()
    navigation: Navigation = Navigation()
    plan: Plan = Plan()
    control: Control = Control()
    estimate: Estimation = Estimation()
    map: Mapping = Mapping()
    require: dict[str, float] = Field(default={}, description='limits on metrics, e.g. "map.le90_m" = 0.05')

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("scenario")))

    @property
    def source(self) -> Source:
        """Where the scenario was read, for faults that are found later."""
        return self._source

    def believed_rig(self) -> StereoRig:
        """The rig's calibration as the estimators know it."""
        rig = self.rig
        focal_px = rig.image_width_px / 2 / float(_tan_deg(rig.hfov_deg / 2))
        forward, left, up = rig.mount_m
        position = [forward, left + rig.baseline_m / 2, up]
        return StereoRig(
            rig.image_width_px,
            rig.image_height_px,
            focal_px,
            rig.baseline_m,
            rig.frame_rate_hz,
            geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array(position)),
        )

    def believed_noise(self) -> SensorNoise:
        """The navigation sensors' data sheet as the estimators know it."""
        navigation = self.navigation
        return SensorNoise(
            navigation.pressure_sigma_m,
            float(np.deg2rad(navigation.attitude_sigma_deg)),
            float(np.deg2rad(navigation.heading_sigma_deg)),
        )

    def fingerprint(self) -> str:
        """Hash of the resolved scenario: equal hash and seed, equal survey."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def _tan_deg(angle_deg: float) -> float:
    return float(np.tan(np.deg2rad(angle_deg)))


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file (or a name in scenes/), with what it extends and `key=value` overrides.

    Raises:
        ScenarioError: every fault of the file, each as `FILE:LINE: key: what is wrong`.
    """
    file = find_scene(path)
    tree, lines = _read(file, seen=())
    source = Source(path=file, lines=lines, overrides=tuple(overrides))
    for override in overrides:
        _apply(tree, override)
    try:
        scenario = Scenario.model_validate(tree)
    except ValidationError as error:
        faults = [_explain(item) for item in error.errors()]
        raise ScenarioError([source.fault(f) for f in faults]) from None
    scenario._source = source
    return scenario


def find_scene(path: str | Path) -> Path:
    """The file of a scenario: a path that exists, or the name of one in scenes/."""
    import scenes

    candidate = Path(path)
    if candidate.is_file():
        return candidate
    folder = Path(scenes.__file__).parent
    names = sorted(p.stem for p in folder.glob("*.toml"))
    if str(path).removesuffix(".toml").removeprefix("scenes/") in names:
        return folder / (str(path).removesuffix(".toml").removeprefix("scenes/") + ".toml")
    raise ScenarioError(
        [f"{path}: no such scenario{_hint(str(path), names)} (allowed: a file, or one of {', '.join(names)})"]
    )


def dump_toml(scenario: Scenario) -> str:
    """The scenario as TOML that `load_scenario` reads back to an equal one."""
    tree = scenario.model_dump(mode="json", exclude_none=True)
    lamps, require = tree.pop("lamps"), tree.pop("require")
    out = [f"{k} = {_toml(v)}" for k, v in tree.items() if not isinstance(v, dict)]
    sections = [(f"[{k}]", v) for k, v in tree.items() if isinstance(v, dict)]
    sections += [("[[lamps]]", lamp) for lamp in lamps] + [("[require]", require)]
    for head, body in sections:
        out += ["", head, *(f"{_toml_key(k)} = {_toml(v)}" for k, v in body.items())]
    return "\n".join(out) + "\n"


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else f'"{key}"'


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


def _read(file: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], dict[str, int]]:
    """One TOML file merged over what it extends, its file paths made absolute, with the line of each key."""
    if file.resolve() in seen:
        raise ScenarioError([f"{file}:1: extends: the file extends itself (allowed: another file)"])
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError([f"{file}:1: cannot be read: {error}"]) from None
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"line (\d+)", str(error))
        number = line[1] if line else len(text.splitlines())
        raise ScenarioError([f"{file}:{number}: not TOML: {error}"]) from None
    lines = _key_lines(text)
    _resolve_paths(tree, file.parent)
    base = tree.pop("extends", None)
    if base is None:
        return tree, lines
    base_file = (file.parent / str(base)).resolve()
    if not base_file.is_file():
        raise ScenarioError([f"{file}:{lines.get('extends', 1)}: extends: no such file {str(base)!r}"])
    base_tree, _ = _read(base_file, (*seen, file.resolve()))
    return _merge(base_tree, tree), lines


def _resolve_paths(tree: dict[str, Any], folder: Path) -> None:
    terrain = tree.get("terrain", {})
    if not isinstance(terrain, dict):
        return
    for key in ("height_file", "texture_file"):
        value = terrain.get(key)
        if isinstance(value, str):
            terrain[key] = str(_expand(value, folder))


def _expand(value: str, folder: Path) -> Path:
    """A path with ${TWIN_DATA} expanded; relative paths are relative to the scenario's folder."""
    data = os.environ.get("TWIN_DATA", "../shared/data")
    if "${TWIN_DATA}" in value:
        return Path(value.replace("${TWIN_DATA}", data)).resolve()
    return (folder / value).resolve()


def _merge(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in top.items():
        nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if nested else value
    return result


def _key_lines(text: str) -> dict[str, int]:
    """Line number of every dotted key of a TOML text; of array tables the items count from 0."""
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    prefix = ""
    for number, line in enumerate(text.splitlines(), 1):
        if array := re.match(r"\s*\[\[\s*([\w.]+)\s*\]\]", line):
            counts[array[1]] = counts.get(array[1], -1) + 1
            prefix = f"{array[1]}.{counts[array[1]]}"
            lines.setdefault(array[1], number)
            lines[prefix] = number
        elif table := re.match(r"\s*\[\s*([\w.]+)\s*\]", line):
            prefix = table[1]
            lines[prefix] = number
        elif key := re.match(r"""\s*(?:"([^"]+)"|'([^']+)'|([\w.-]+))\s*=""", line):
            name = key[1] or key[2] or key[3]
            lines[f"{prefix}.{name}" if prefix else name] = number
    return lines


def _apply(tree: dict[str, Any], override: str) -> None:
    """Sets one `a.b=value` in the tree; the value is read as TOML, else as text."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ScenarioError([f"--set {override}: not of the form key=value (for instance plan.tracks=2)"])
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text
    *parents, leaf = key.strip().split(".")
    if parents[:1] == ["require"]:
        parents, leaf = ["require"], ".".join([*parents[1:], leaf]).strip('"')
    node: Any = tree
    for part in parents:
        node = _enter(node, part, override)
        if not isinstance(node, dict | list):
            raise ScenarioError([f"--set {override}: {part} is a value, not a section"])
    if isinstance(node, list):
        raise ScenarioError([f"--set {override}: name one of the list, as in {'.'.join(parents)}.0.{leaf}=..."])
    node[leaf] = value
    if key.strip() in ("terrain.height_file", "terrain.texture_file"):
        node[leaf] = str(_expand(str(value), Path.cwd()))


def _enter(node: Any, part: str, override: str) -> Any:
    """The section or list item of this name."""
    if not isinstance(node, list):
        return node.setdefault(part, {})
    if not part.isdigit() or int(part) >= len(node):
        raise ScenarioError([f"--set {override}: no item {part} (allowed: 0 to {len(node) - 1})"])
    return node[int(part)]


def _explain(item: Any) -> TwinError:
    """One pydantic error in the words of the house."""
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        allowed = _fields(item["loc"][:-1])
        return TwinError(where, f"unknown key{_hint(str(item['loc'][-1]), allowed)}", ", ".join(allowed))
    value = item.get("input")
    shown = "" if isinstance(value, dict) else f"{value!r}: "
    if item["type"] == "missing":
        return TwinError(where, "missing", "a value must be given")
    return TwinError(where, f"{shown}not allowed", _ALLOWED.get(item["type"]) or item["msg"].removeprefix(_PREFIX))


_PREFIX = "Input should be "
#: What pydantic says in words of its own, in the words of a scenario.
_ALLOWED = {
    "model_type": "a section",
    "tuple_type": "a list",
    "dict_type": "a section",
    "string_type": "a text",
    "string_too_short": "a text that is not empty",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}


def _fields(location: Iterable[Any]) -> list[str]:
    """Names of the keys allowed in the section at this place."""
    model: Any = Scenario
    for part in location:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        arguments = getattr(annotation, "__args__", (annotation,))
        model = next(a for a in arguments if isinstance(a, type) and issubclass(a, BaseModel))
    return list(model.model_fields)


def _hint(word: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, names, n=1)
    return f" (did you mean {close[0]}?)" if close else ""
