"""Live runs: capture in a thread of its own, load shedding, health, and serving its state."""

from torchvision_dddas.live.capture import LiveSource
from torchvision_dddas.live.health import Health, Snapshot
from torchvision_dddas.live.runner import LoadShedding

__all__ = ["Health", "LiveSource", "LoadShedding", "Snapshot"]
