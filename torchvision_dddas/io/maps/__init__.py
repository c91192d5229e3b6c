"""Maps of located targets: GeoJSON, KML, Cursor-on-Target, and a picture."""

from torchvision_dddas.io.maps.formats import STALE_S, cot, encode_geojson, event, event_uid, geojson, kml
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks, iso_utc, semi_axes
from torchvision_dddas.io.maps.map_picture import CameraPath, Signs, map_picture, round_step, view_of

__all__ = [
    "STALE_S",
    "CameraPath",
    "Gathered",
    "GroundTracks",
    "Signs",
    "cot",
    "encode_geojson",
    "event",
    "event_uid",
    "geojson",
    "iso_utc",
    "kml",
    "map_picture",
    "round_step",
    "semi_axes",
    "view_of",
]
