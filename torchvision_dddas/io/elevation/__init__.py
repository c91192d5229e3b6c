"""Rasters of the ground, georeferenced: its heights, and photos of it from straight above."""

from torchvision_dddas.io.elevation.heights import read_elevation
from torchvision_dddas.io.elevation.photo import read_ortho

__all__ = ["read_elevation", "read_ortho"]
