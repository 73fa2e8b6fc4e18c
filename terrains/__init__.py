"""Seafloor terrains: height grids with textures, generated or read from files."""

from twin.terrains.generate import generate, generate_from
from twin.terrains.load import load
from twin.terrains.terrain import Terrain
from twin.terrains.textures import TextureSource

__all__ = ["Terrain", "TextureSource", "generate", "generate_from", "load"]
