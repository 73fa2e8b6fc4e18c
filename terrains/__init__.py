"""Seafloor terrains: height grids with textures, generated or read from files."""

from terrains.generate import generate
from terrains.load import load
from terrains.terrain import Terrain
from terrains.textures import TextureSource

__all__ = ["Terrain", "TextureSource", "generate", "load"]
