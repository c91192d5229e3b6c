"""Streams of results while a run goes on: newline JSON, MOTChallenge text, Cursor-on-Target events."""

from torchvision_dddas.io.streams.messages import About, json_lines
from torchvision_dddas.io.streams.stream import Stream, open_stream, open_streams

__all__ = ["About", "Stream", "json_lines", "open_stream", "open_streams"]
