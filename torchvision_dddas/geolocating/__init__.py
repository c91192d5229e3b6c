"""From the picture to the ground, seen from the air: landmarks and telemetry on one plane, then frame by frame."""

from torchvision_dddas.geolocating.locator import Locator, Targets
from torchvision_dddas.geolocating.site import Site, camera_of, site_of
from torchvision_dddas.geolocating.table import check_table, locate

__all__ = ["Locator", "Site", "Targets", "camera_of", "check_table", "locate", "site_of"]
