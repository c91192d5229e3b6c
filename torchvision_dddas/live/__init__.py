"""A run that keeps up with a camera: capture in a thread of its own, less work where it takes too long, health."""

from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Event, Health, Snapshot
from torchvision_dddas.live.load_shedding import LoadShedding

__all__ = ["Event", "Health", "LiveSource", "LoadShedding", "Snapshot"]
