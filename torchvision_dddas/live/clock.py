"""Time as a live run sees it, so that tests can have their own."""

import threading
import time


class Clock:
    """The clocks of this machine."""

    def now(self) -> float:
        """Seconds that only go forward."""
        return time.monotonic()

    def utc(self) -> float:
        """Seconds since 1970, as far as the machine knows."""
        return time.time()

    def wait(self, changed: threading.Condition, seconds: float | None = None) -> None:
        """Until someone notifies the condition, which the caller holds, or so many seconds are over."""
        changed.wait(seconds)
