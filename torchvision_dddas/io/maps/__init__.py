"""Maps of located targets: GeoJSON, KML, Cursor-on-Target, and a picture."""

from torchvision_dddas.io.maps.cot import cot
from torchvision_dddas.io.maps.ellipses import semi_axes
from torchvision_dddas.io.maps.geojson import encode_geojson, geojson
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks, iso_utc
from torchvision_dddas.io.maps.kml import kml
from torchvision_dddas.io.maps.map_drawing import round_step
from torchvision_dddas.io.maps.map_picture import CameraPath, Signs, map_picture, view_of

__all__ = [
    "CameraPath",
    "Gathered",
    "GroundTracks",
    "Signs",
    "cot",
    "encode_geojson",
    "geojson",
    "iso_utc",
    "kml",
    "map_picture",
    "round_step",
    "semi_axes",
    "view_of",
]
