"""Digital twin of an underwater stereo survey: simulation, estimators, and evaluation against the truth."""

from typing import TYPE_CHECKING, Any

from twin.api import compare, export, load_run, load_scenario, look, plan, replay, run, study, tune, vehicle

from twin.api import map_change, map_products  # isort: skip

if TYPE_CHECKING:
    from twin.session.stepped_world import SteppedWorld as World

    __version__: str

__all__ = [
    "World", "__version__", "compare", "export", "load_run", "load_scenario", "look", "map_change", "map_products",
    "plan", "replay", "run", "study", "tune", "vehicle",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Returns `twin.World`, which needs the simulator, or the version, when they are asked for."""
    if name == "World":
        from twin.session.stepped_world import SteppedWorld

        return SteppedWorld
    if name == "__version__":
        from importlib.metadata import version

        return version("seabed-twin")
    raise AttributeError(f"module 'twin' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
