"""The overlay of a run: the clip with everything found drawn in."""

from torchvision_dddas.io.overlay.drawing import (
    LETTERS,
    LIKELY,
    Colour,
    RunPictures,
    ToMetres,
    TrackPictures,
    Trails,
    colour_picture,
    command_metres,
    draw_people,
    draw_scene,
    drawable,
    identity_colour,
    label,
)
from torchvision_dddas.io.overlay.video import OverlayPicture, OverlayVideo

__all__ = [
    "LETTERS",
    "LIKELY",
    "Colour",
    "OverlayPicture",
    "OverlayVideo",
    "RunPictures",
    "ToMetres",
    "TrackPictures",
    "Trails",
    "colour_picture",
    "command_metres",
    "draw_people",
    "draw_scene",
    "drawable",
    "identity_colour",
    "label",
]
