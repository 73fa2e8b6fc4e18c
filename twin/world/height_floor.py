"""Sea floor of a scenario as a height grid: generated, or read from its files."""

from twin import terrains
from twin.plugin.guard import terrain_heights
from twin.scenario.model import Scenario
from twin.terrains.ground_cover import DEFAULT_COVERS


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
