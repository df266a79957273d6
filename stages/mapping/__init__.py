"""Mapping: the georeferenced radiance cube of a line."""

from stages.mapping.cube import run
from stages.mapping.grid import MappingSettings, line_grid, share_outside, surface

__all__ = ["MappingSettings", "line_grid", "run", "share_outside", "surface"]
