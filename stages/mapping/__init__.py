"""Mapping: the georeferenced radiance cube of a line."""

from stages.mapping.cube import MappingSettings, line_grid, run, surface

__all__ = ["MappingSettings", "line_grid", "run", "surface"]
