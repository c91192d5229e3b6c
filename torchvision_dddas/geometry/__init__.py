"""Geometry for all fields: boxes, plane maps, rotations, matching, geodesy, projection. It needs NumPy and OpenCV."""

from torchvision_dddas.geometry.boxes import Box, connected_parts, inside, middles_of, occupied, shared_px, window_of
from torchvision_dddas.geometry.circular_error import circular_error_90, error_category
from torchvision_dddas.geometry.geodesy import (
    DEGREE_M,
    Degrees,
    east_north,
    great_circle_m,
    lonlat,
    plain_east_north,
    plain_lonlat,
)
from torchvision_dddas.geometry.geoid import GEOID_SIGMA_M, geoid_height
from torchvision_dddas.geometry.jitter import Jitter
from torchvision_dddas.geometry.matching import best_pairs, cheapest, load_assignment_solver
from torchvision_dddas.geometry.namespace import namespace
from torchvision_dddas.geometry.plane_maps import background_flow, chain, corner_error, transfer
from torchvision_dddas.geometry.polygons import (
    Edges,
    area_of,
    crosses_itself,
    crossings,
    edges_of,
    is_inside,
    nearest_on,
)
from torchvision_dddas.geometry.poses import poses_at
from torchvision_dddas.geometry.projection import (
    Surface,
    axes_of,
    distort_pixels,
    ground_height,
    ground_with_slopes,
    inverse_2x2,
    normalize,
    project,
    project_with_slopes,
    rays,
    shift_origin,
    surface_of,
    undistort_pixels,
)
from torchvision_dddas.geometry.rotations import about_up, cross, slope_of_turn, turn_of, turned

__all__ = [
    "DEGREE_M",
    "GEOID_SIGMA_M",
    "Box",
    "Degrees",
    "Edges",
    "Jitter",
    "Surface",
    "about_up",
    "area_of",
    "axes_of",
    "background_flow",
    "best_pairs",
    "chain",
    "cheapest",
    "circular_error_90",
    "connected_parts",
    "corner_error",
    "cross",
    "crosses_itself",
    "crossings",
    "distort_pixels",
    "east_north",
    "edges_of",
    "error_category",
    "geoid_height",
    "great_circle_m",
    "ground_height",
    "ground_with_slopes",
    "inside",
    "inverse_2x2",
    "is_inside",
    "load_assignment_solver",
    "lonlat",
    "middles_of",
    "namespace",
    "nearest_on",
    "normalize",
    "occupied",
    "plain_east_north",
    "plain_lonlat",
    "poses_at",
    "project",
    "project_with_slopes",
    "rays",
    "shared_px",
    "shift_origin",
    "slope_of_turn",
    "surface_of",
    "transfer",
    "turn_of",
    "turned",
    "undistort_pixels",
    "window_of",
]
