"""Objects of a scenario: loaded or built, and placed on the floor."""

import os
import pickle
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import numpy as np

from twin import terrains
from twin.errors import TwinError
from twin.kernels import cache_folder
from twin.scenario.model import ObjectConfig, Scenario
from twin.terrains.objects.mesh_file import read_mesh
from twin.terrains.objects.placed_object import ObjectModel, PlacedObject, grown, model_of
from twin.terrains.objects.scattering import check_inside, place
from twin.terrains.objects.shapes import SHAPES, build_shape
from twin.world.scenario_checks import keys_without_effect

GREY = (0.4, 0.4, 0.4)  #: albedo of a mesh without colours
SHAPE_SIZE_M = 0.4  #: size of a built-in shape without `size_m`
MAX_FACES = 8_000_000  #: largest number of triangles of all built-in shapes and mesh files together
MAX_OBJECTS = 20_000
_MOST_KEPT = 96  #: built models on disk; those written first are removed

Attempt = Callable[[Callable[[], object]], object]


def load_objects(scenario: Scenario, terrain: terrains.Terrain, attempt: Attempt) -> tuple[PlacedObject, ...]:
    """Returns the objects of a scenario; objects with equal shapes share one model.

    `attempt` calls a function and collects its TwinError, see `mission.prepare`; entries with errors are left out.
    """
    models: dict[str, tuple[ObjectModel, ...]] = {}
    found: list[PlacedObject] = []
    for scattered in (False, True):  # scattered objects avoid those at given positions
        for number, config in enumerate(scenario.objects):
            if (config.position_m is None) == scattered:
                ground = terrain, scenario.seed_of_scene
                attempt(lambda k=number, c=config, g=ground: found.extend(_entry(k, c, models, found, g)))
    later: list[PlacedObject] = []
    count: Counter[int] = Counter()
    for item in found:  # after all are placed, so that a change moves no other object
        config, number = scenario.objects[item.group], count[item.group]
        attempt(lambda i=item, c=config, n=number: later.extend(_changed(i, c, n, terrain)))
        count[item.group] += 1
    return tuple(later)


def _changed(item: PlacedObject, config: ObjectConfig, number: int, terrain: terrains.Terrain) -> list[PlacedObject]:
    """Returns an object as it is at the time of the survey, with its number in its entry; [] if it is gone."""
    if number in config.removed:
        return []
    if not config.growth_m or (config.growing is not None and number not in config.growing):
        return [item]
    field = f"objects.{item.group}.growth_m"
    item = grown(item, config.growth_m, field)
    check_inside(item, terrain, field)
    return [item]


def _entry(
    number: int, config: ObjectConfig, models: dict[str, tuple[ObjectModel, ...]], found: list[PlacedObject],
    world: tuple[terrains.Terrain, int],
) -> list[PlacedObject]:  # fmt: skip
    """Returns the objects of one entry of `[[objects]]` and adds its models to `models`."""
    _check_keys(f"objects.{number}", config)
    terrain, seed = world
    variant = None if config.position_m is None or config.shape == "mesh" else number % SHAPES[config.shape].variants
    key = repr((config.shape, config.mesh_file, config.mesh_up, config.colour, _pipe_width(config), variant))
    if key not in models:
        models[key] = _models(number, config, seed, variant)
        n_faces = sum(len(model.levels[0].mesh.faces) for shapes in models.values() for model in shapes)
        if n_faces > MAX_FACES:
            raise TwinError(f"objects.{number}", f"{n_faces} triangles in all meshes", f"at most {MAX_FACES} triangles")
    sized = config
    if config.size_m is None and config.shape != "mesh":
        sized = config.model_copy(update={"size_m": SHAPE_SIZE_M})
    items = place(number, sized, models[key], terrain, found, seed)
    if len(found) + len(items) > MAX_OBJECTS:
        raise TwinError(f"objects.{number}", f"{len(found) + len(items)} objects", f"at most {MAX_OBJECTS} objects")
    _check_numbers(f"objects.{number}", config, len(items))
    return items


def _check_numbers(path: str, config: ObjectConfig, n_objects: int) -> None:
    if config.growing is not None and not config.growth_m:
        raise TwinError(f"{path}.growing", "has no effect without growth_m", "a growth_m, or without it")
    for key, numbers in (("growing", config.growing or ()), ("removed", config.removed)):
        for number in numbers:
            if number >= n_objects:
                raise TwinError(f"{path}.{key}", f"{number}: no such object", f"0 to {n_objects - 1}")


def _models(number: int, config: ObjectConfig, seed: int, variant: int | None) -> tuple[ObjectModel, ...]:
    """Returns the models of an entry: that of its mesh file, or the given variant of a built-in shape (None: all)."""
    if config.shape == "mesh":
        assert config.mesh_file is not None
        file = Path(config.mesh_file)
        y_up = config.mesh_up == "y" or (config.mesh_up is None and file.suffix.lower() == ".glb")
        return (model_of(read_mesh(file, f"objects.{number}.mesh_file", config.colour or GREY, y_up)),)
    shape, name = SHAPES[config.shape], zlib.crc32(config.shape.encode())
    form = {"width": _pipe_width(config)} if config.shape == "pipe" and config.width_m else {}
    seeds = np.random.SeedSequence([seed, name]).spawn(shape.variants)
    if variant is not None:
        seeds = [seeds[variant]]
    return tuple(built_model(config.shape, config.colour, each, **form) for each in seeds)


def _pipe_width(config: ObjectConfig) -> float:
    return (config.width_m or 0.0) / (config.size_m or SHAPE_SIZE_M)


def _check_keys(path: str, config: ObjectConfig) -> None:
    if config.shape == "mesh" and config.mesh_file is None:
        raise TwinError(f"{path}.mesh_file", "missing", 'a mesh, as shape is "mesh"')
    if (config.position_m is None) == (config.per_m2 is None):
        given = "both are given" if config.per_m2 is not None else "missing"
        raise TwinError(f"{path}.position_m", given, "either position_m or per_m2")
    unused = [] if config.shape == "mesh" else ["mesh_file", "mesh_up"]
    unused += [] if config.shape == "pipe" else ["width_m"]
    for error in keys_without_effect(path, config, unused, f"has no effect on shape {config.shape!r}", "without it"):
        raise error
    scattered = config.per_m2 is not None
    kind = "scattered objects" if scattered else "an object at position_m"
    unused = ["height_m"] if scattered else ["on", "area_m", "centre_m", "spacing_m"]
    for error in keys_without_effect(path, config, unused, f"has no effect on {kind}", "without it"):
        raise error
    if config.shape == "pipe" and config.width_m and _pipe_width(config) > 1:
        allowed = f"up to {config.size_m or SHAPE_SIZE_M:g}"
        raise TwinError(f"{path}.width_m", f"{config.width_m:g}: wider than long", allowed)


def built_model(
    shape: str, albedo: tuple[float, float, float] | None, seed: np.random.SeedSequence, **form: float
) -> ObjectModel:
    """Returns the model of a built-in shape (`build_shape`), from disk if it was built before: a reef takes seconds."""
    key = repr((np.__version__, shape, albedo, seed.entropy, seed.spawn_key, sorted(form.items())))

    def build() -> ObjectModel:
        return model_of(build_shape(shape, albedo, np.random.default_rng(seed), **form), SHAPES[shape].sways)

    folder = cache_folder(Path(__file__).resolve(), __name__)
    return build() if folder is None else _kept(folder / f"{sha256(key.encode()).hexdigest()[:32]}.pickle", build)


def _kept(file: Path, build: Callable[[], ObjectModel]) -> ObjectModel:
    """Returns the object in a file; builds and writes it if there is none, or if it is damaged."""
    with suppress(OSError, EOFError, ValueError, pickle.UnpicklingError):
        return pickle.loads(file.read_bytes())
    model, part = build(), file.with_suffix(f".{os.getpid()}.part")
    with suppress(OSError):  # of a full disk
        part.write_bytes(pickle.dumps(model, pickle.HIGHEST_PROTOCOL))
        part.replace(file)
        for old in sorted(file.parent.glob("*.pickle"), key=lambda kept: kept.stat().st_mtime)[:-_MOST_KEPT]:
            old.unlink()
    return model
