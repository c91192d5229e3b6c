"""A run whose source can be steered: what is reported meanwhile, what ground vehicles see, and where all go next."""

from torchvision_dddas.control.closed_loop import Mission, fitted, mission_of
from torchvision_dddas.control.ground_confirmation import CloserLook
from torchvision_dddas.control.sensor_monitor import Notice, Vigilance
from torchvision_dddas.control.vehicles import Begun, Instrument

__all__ = ["Begun", "CloserLook", "Instrument", "Mission", "Notice", "Vigilance", "fitted", "mission_of"]
