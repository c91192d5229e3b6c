"""Where scenes go: tables, masks, an overlay video, and the record of the run."""

from torchvision_dddas.io.output.detection_output import SAVED, Output, Sink, saved

__all__ = ["SAVED", "Output", "Sink", "saved"]
