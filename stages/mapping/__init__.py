"""Mapping: the georeferenced radiance cube of a line."""

from stages.mapping.cube import MapGrid, MappingSettings, line_grid, run

__all__ = ["MapGrid", "MappingSettings", "line_grid", "run"]
