"""A run whose source can be steered: what is reported meanwhile, what ground vehicles see, and where all go next."""

from torchvision_dddas.mission.closer import CloserLook
from torchvision_dddas.mission.instrument import Begun, Instrument
from torchvision_dddas.mission.mission import Mission, fitted, mission_of
from torchvision_dddas.mission.vigilance import Notice, Vigilance

__all__ = ["Begun", "CloserLook", "Instrument", "Mission", "Notice", "Vigilance", "fitted", "mission_of"]
