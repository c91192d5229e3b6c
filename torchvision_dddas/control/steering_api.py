"""What is found steers the instruments: which frames are looked at, where the vehicles go, and at what they look."""

from torchvision_dddas.control.commands import Steering

__all__ = ["Steering"]
