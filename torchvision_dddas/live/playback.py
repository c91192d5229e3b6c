"""A recording as if it were filmed now."""

import threading

import numpy as np

from torchvision_dddas.io.images import ImageSource
from torchvision_dddas.io.video import VideoSource
from torchvision_dddas.live.capture_log import Diary
from torchvision_dddas.live.clock import Clock
from torchvision_dddas.live.frame_queue import Inbox
from torchvision_dddas.live.health import Health
from torchvision_dddas.types import Frame, Source

# A reader that is later than this is not waited for by the clock: its pictures would come in one burst.
_LATE_S = 1.0


class Player:
    """Plays a recording `pace` times as fast as it was filmed; 0: as fast as it is taken."""

    def __init__(
        self, recording: Source, pace: float, inbox: Inbox, diary: Diary, health: Health, clock: Clock
    ) -> None:
        self._recording, self._pace, self._inbox, self._diary = recording, pace, inbox, diary
        self._health, self._clock = health, clock
        if isinstance(recording, (VideoSource, ImageSource)):
            recording.tolerant = True  # a picture of another size is left out as one that cannot be decoded
        self._thread = threading.Thread(target=self._play, name="playing", daemon=True)

    @property
    def apart_s(self) -> float:
        """Seconds from picture to picture; 0 where they wait."""
        return 1 / (self._recording.rate_hz * self._pace) if self._pace else 0.0

    @property
    def threads(self) -> list[threading.Thread]:
        """Those that may be alive."""
        return [self._thread]

    def begin(self) -> None:
        """Somebody takes pictures from now on."""
        self._thread.start()

    def check(self) -> float | None:
        """Nothing is to be looked after."""
        return None

    def _play(self) -> None:
        inbox, start_s = self._inbox, float("nan")
        try:
            for frame in self._recording:
                self._report()
                start_s = self._clock.now() if np.isnan(start_s) else start_s
                if self._pace:
                    due_s = start_s + frame.time_s / self._pace
                    if (late_s := self._clock.now() - due_s) > _LATE_S:
                        self._diary.tell(f"reading is slower than playing: {late_s:.1f} s late", topic="late")
                        start_s += late_s
                    inbox.sleep(due_s)
                else:
                    inbox.make_room()
                if inbox.closed:
                    return
                taken_s = self._clock.now()
                self._health.count("undecoded", frame.number - self._diary.number - 1)
                self._diary.number = frame.number
                self._diary.captured(taken_s)
                if inbox.wanted(frame.number):
                    inbox.put(Frame(frame.number, frame.time_s, frame.image, 0, taken_s))
        except Exception as error:  # told, and the end of the recording: the run settles what it has
            self._diary.tell(f"the recording cannot be read further: {error}")
        finally:
            self._report()
            inbox.end()

    def _report(self) -> None:
        for problem in self._recording.problems:
            self._diary.tell(problem.what, problem.frame, topic="damage")
        self._recording.problems.clear()
