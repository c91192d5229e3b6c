"""From the picture to the ground, seen from the air: landmarks and telemetry on one plane, then frame by frame."""

from torchvision_dddas.geo.aerial_locator import Locator, Targets
from torchvision_dddas.geo.crowd_grouping import gathered
from torchvision_dddas.geo.landmark_watch import Watch, Watched, check_colours, unpictured
from torchvision_dddas.geo.site import Site, camera_of, check_span, local, site_of, unknown_heights
from torchvision_dddas.geo.table_location import check_table, locate

__all__ = [
    "Locator",
    "Site",
    "Targets",
    "Watch",
    "Watched",
    "camera_of",
    "check_colours",
    "check_span",
    "check_table",
    "gathered",
    "local",
    "locate",
    "site_of",
    "unknown_heights",
    "unpictured",
]
