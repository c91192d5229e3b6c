"""From the picture to the ground, seen from the air: landmarks and telemetry on one plane, then frame by frame."""

from torchvision_dddas.geolocating.gathering import gathered
from torchvision_dddas.geolocating.locator import Locator, Targets
from torchvision_dddas.geolocating.naming import named
from torchvision_dddas.geolocating.site import Site, camera_of, check_span, local, site_of, unknown_heights
from torchvision_dddas.geolocating.table import check_table, locate
from torchvision_dddas.geolocating.watch import Watch, Watched, check_colours, unpictured

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
    "named",
    "site_of",
    "unknown_heights",
    "unpictured",
]
