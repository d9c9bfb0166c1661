"""Procedural scenes by seed and kind."""

from links.simulated.world.procedural.build import World, build_world, world_mesh
from links.simulated.world.procedural.settings import SceneSettings

__all__ = ["SceneSettings", "World", "build_world", "world_mesh"]
