"""The sea floor as numbers."""

from terrains.generate import generate
from terrains.load import load
from terrains.terrain import Terrain, TerrainFault

__all__ = ["Terrain", "TerrainFault", "generate", "load"]
