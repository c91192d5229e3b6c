"""Results as they come, for others to read while the run goes on: newline JSON, MOT text, Cursor-on-Target events."""

from torchvision_dddas.io.streams.opening import open_stream, open_streams
from torchvision_dddas.io.streams.stream import About, Stream

__all__ = ["About", "Stream", "open_stream", "open_streams"]
