"""Where the messages of a stream go."""

from collections.abc import Sequence
from typing import Protocol


class Outlet(Protocol):
    """A place that takes messages, one after another, without ever waiting long.

    most_bytes: of a message; 0: any. lost: messages that nobody got so far; reason: why the last of them, in words.
    """

    most_bytes: int
    lost: int
    reason: str

    def put(self, messages: Sequence[bytes]) -> None:
        """Keep messages until they can be sent. What is kept is bounded: then the oldest are lost."""

    def flush(self) -> None:
        """Send what is kept as far as it is taken now, each message whole or not at all. Raises OSError on trouble."""

    def mend(self) -> None:
        """After trouble: make ready to send again. Raises OSError if it cannot."""

    def handle(self) -> int | None:
        """A new descriptor of the file that was written, for whoever puts it on the disk; None where there is none."""

    def close(self) -> None:
        """Send what can be sent soon and count the rest as lost. Never raises."""
