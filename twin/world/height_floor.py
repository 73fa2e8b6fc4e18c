"""Sea floor of a scenario as a height grid: the true one, generated or read, and that known before the survey."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter

from twin import terrains
from twin.errors import TwinError
from twin.plugin.guard import terrain_heights
from twin.scenario.model import Scenario, TerrainConfig
from twin.terrains import Terrain
from twin.terrains.ground_cover import DEFAULT_COVERS
from twin.world.planning import level_plan, mean_height_m


def load_terrain(scenario: Scenario) -> terrains.Terrain:
    """Returns the floor of a scenario whose floor is no mesh; without images, its texture is coarse and not tiled.

    Raises TwinError if the floor cannot be generated or read.
    """
    t, rendered = scenario.terrain, scenario.imaging.fidelity == "rendered"
    if t.kind == "file":
        texture = terrains.TextureSource(
            scenario.texel_m, t.texture_file, t.texture_tiling if rendered else "repeat", t.orthophoto_file, t.cover,
            coarsen=t.texture_px_m is None, walls=scenario.has_walls,
            in_images=rendered or t.texture_file is not None or t.orthophoto_file is not None,
        )  # fmt: skip
        assert t.height_file is not None  # `scenario_checks.floor_contradictions`
        return terrains.load(t.height_file, texture, t.height_spacing_m, t.height_range_m, scenario.seed_of_scene, t.z)
    texture = terrains.TextureSource(
        scenario.texel_m if rendered else t.grid_m, cover=t.cover, coarsen=t.texture_px_m is None,
        walls=scenario.has_walls,
    )  # fmt: skip
    if (plugin := t.plugin) is None:
        return terrains.generate(t.kind, t.size_m, t.relief_m, t.base_m, t.grid_m, texture, scenario.seed_of_scene)
    return terrains.generate_from(
        lambda x_m, y_m, _: terrain_heights(plugin, x_m, y_m, scenario.seed_of_scene),
        t.size_m, t.grid_m, texture, t.cover or DEFAULT_COVERS[t.kind], scenario.seed_of_scene,
    )  # fmt: skip


def chart_of(scenario: Scenario, floor: Terrain) -> Terrain:
    """Returns the floor as it is known before the survey, on the grid of the true one.

    Without a prior it is level, at the mean height of the true one in an image at the start of the path: the vehicle
    dives there to the planned altitude above the floor. Raises TwinError if `terrain.prior_file` cannot be read, or its
    coordinates are not those of the true floor, or no path can be planned.
    """
    t = scenario.terrain
    if t.prior == "none":
        level = replace(floor, height_m=np.zeros_like(floor.height_m), known=None, filled=None)
        plan = level_plan(scenario, level)
        x, y, _ = plan.reference(1, 0.0).position.tolist()
        return replace(
            level, height_m=level.height_m + np.float32(mean_height_m(floor, (x, y), plan.request.footprint_m))
        )
    chart = floor if t.prior_file is None else _of_file(t, t.prior_file, floor)
    if not (t.prior_smoothing_m or t.prior_offset_m):
        return chart
    smooth = gaussian_filter(chart.height_m, t.prior_smoothing_m / chart.spacing_m, mode="nearest")
    return replace(chart, height_m=(smooth + np.float32(t.prior_offset_m)).astype(np.float32))


def _of_file(t: TerrainConfig, file: str, floor: Terrain) -> Terrain:
    texture = terrains.TextureSource(1.0, in_images=False)
    try:
        prior = terrains.load(file, texture, t.height_spacing_m, t.height_range_m, 0, t.z)
    except TwinError as error:
        raise TwinError("terrain.prior_file", error.problem, error.allowed) from error
    here, there = floor.georeference, prior.georeference
    if here is None or there is None or here.crs_wkt != there.crs_wkt or here.vertical_datum != there.vertical_datum:
        raise TwinError("terrain.prior_file", f"{file}: not in the coordinates of the floor", "CRS of height_file")
    x = floor.west_m + floor.spacing_m * np.arange(floor.height_m.shape[1])
    y = floor.south_m + floor.spacing_m * np.arange(floor.height_m.shape[0])
    position = there.to_scene(*here.from_scene(*np.meshgrid(x, y)))
    height_m = prior.height_near(*position) + (there.elevation_m - here.elevation_m)
    known = np.isfinite(prior.height_at(*position)) & ~prior.in_hole(*position)
    return replace(floor, height_m=height_m.astype(np.float32), filled=None, known=None if known.all() else known)
