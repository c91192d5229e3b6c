"""Streams of results while a run goes on: newline JSON, MOTChallenge text, Cursor-on-Target events."""

from torchvision_dddas.io.streams.opening import open_stream, open_streams
from torchvision_dddas.io.streams.stream import About, Stream

__all__ = ["About", "Stream", "open_stream", "open_streams"]
