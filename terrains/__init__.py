"""Seafloor terrains: height grids with textures, generated or read from files."""

from terrains.generate import default_cover, generate, generate_from
from terrains.load import load
from terrains.terrain import Terrain
from terrains.textures import TextureSource

__all__ = ["Terrain", "TextureSource", "default_cover", "generate", "generate_from", "load"]
