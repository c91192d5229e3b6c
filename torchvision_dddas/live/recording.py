"""Record the annotated pictures of a live run: overlay.mp4, short clips around events, and streams that send them on.

The run hands over references and does not wait. One thread draws and encodes each picture once, for all outputs.
"""

import math
import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path

import numpy as np

from torchvision_dddas.io.overlay import RunPictures
from torchvision_dddas.io.streams import About, Stream
from torchvision_dddas.io.video_packets import HZ, VideoEncoder, VideoFile, VideoPacket, pad_to_even
from torchvision_dddas.live.operator_view import draw_result
from torchvision_dddas.live.team import give_way
from torchvision_dddas.types import Frame, FrameResult, TrackedFrame, Zone, is_sampled

RECORDED = ("overlay", "clips")
"""Values of --save in a live run."""

_MOST_PICTURES = 32  # pictures that wait for their results, and pictures that wait to be drawn
_MOST_RESULTS = 1000  # results that wait to be drawn, most of them without a picture
_PART_S = 600.0  # length of a file of the overlay
_LONGEST_S = 60.0  # longest clip; a later event begins the next clip
_SETTLED_S = 10.0  # longest time from an event to its report
_MOST_BYTES = 32 << 20  # most bytes of encoded pictures that are kept for the next event
_CLOSE_S = 30.0  # longest time at the end for pictures that still wait

Notify = Callable[[str, str], object]


class PacketOutput:
    """An output that takes the encoded pictures of results. name: for messages."""

    name = ""
    _file: VideoFile | None = None  # the file that is being written

    def write(self, result: FrameResult, packets: Sequence[VideoPacket], encoder: VideoEncoder) -> None:
        """Take the packets of a result. Raise any exception for an output that has failed."""
        raise NotImplementedError

    def close(self) -> None:
        """Complete the output."""

    def discard(self) -> None:
        """Remove the unfinished file after a failure. Never raise."""
        if self._file is not None:
            self._file.discard()


class Recorder:
    """Draws results, and gives their packets to outputs. The run calls `take`, `show` and `close`.

    An output that fails ends with an event; the others and the run go on.
    """

    def __init__(
        self,
        outputs: Sequence[PacketOutput],
        rate_hz: float,
        interval: int,
        about: About,
        zones: Sequence[Zone],
        notify: Notify,
        waits: bool = False,
    ) -> None:
        """about: a record of its own; the thread sets the start time of each result in it.

        notify: called with a kind and a message. waits: the run waits, so that the recording lacks nothing.
        """
        self._outputs, self._rate_hz, self._interval = list(outputs), rate_hz / interval, interval
        self._about, self._zones, self._notify, self._waits = about, zones, notify, waits
        self._images: dict[int, np.ndarray] = {}  # by frame number, until the result comes
        self._queue = queue.Queue[tuple[FrameResult, TrackedFrame | None, np.ndarray | None, float] | None]()
        self._drawn = threading.Semaphore(_MOST_PICTURES)
        self._left_out = self._count = 0
        self._pictures: RunPictures | None = None
        self._encoder: VideoEncoder | None = None
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def take(self, frame: Frame) -> None:
        """Keep the picture of a frame until its result comes."""
        if not self._outputs or not is_sampled(frame.number, self._interval):
            return
        self._count += 1
        if self._waits or len(self._images) < _MOST_PICTURES:
            self._images[frame.number] = frame.image
        else:
            self._left_out += 1

    def show(self, result: FrameResult, people: TrackedFrame | None, start_utc_s: float) -> None:
        """Record a result. start_utc_s: as in `About`, for this result."""
        image = self._images.get(result.number)
        self._images = {k: kept for k, kept in self._images.items() if k > result.number}
        if result.frame is None or not self._outputs:
            return
        has_room = self._queue.qsize() < _MOST_RESULTS
        if image is not None and not (has_room and self._drawn.acquire(blocking=self._waits)):
            image = None
            self._left_out += 1
        if has_room:
            self._queue.put((result, people, image, start_utc_s))

    def close(self) -> None:
        """Complete the outputs."""
        if not self._thread.is_alive():
            return
        self._queue.put(None)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._notify("sink", f"the recording takes longer than {_CLOSE_S:g} s to end, and is left unfinished")
        elif self._left_out:
            words = (
                f"the recording lacks {self._left_out} of {self._count} pictures: drawing and encoding took too long"
            )
            self._notify("sink", words)

    def _run(self) -> None:
        give_way()
        while (item := self._queue.get()) is not None:
            result, people, image, self._about.start_utc_s = item
            try:
                packets = self._encode(result, people, image)
            except Exception as error:  # a defect of this package must not end a run
                self._end(self._outputs, error)
                packets = []
            if image is not None:
                self._drawn.release()
            for output in tuple(self._outputs):
                try:
                    if self._encoder is not None:
                        output.write(result, packets, self._encoder)
                except Exception as error:
                    self._end([output], error)
        for output in tuple(self._outputs):
            try:
                output.close()
            except Exception as error:
                self._end([output], error)

    def _encode(self, result: FrameResult, people: TrackedFrame | None, image: np.ndarray | None) -> list[VideoPacket]:
        assert result.frame is not None
        if image is None:
            if self._pictures is not None:
                self._pictures.show(result)
            return []
        height, width = image.shape[:2]
        even = width + width % 2, height + height % 2
        if self._encoder is None or self._pictures is None or self._encoder.size_px != even:
            self._encoder = VideoEncoder(even, self._rate_hz)
            self._pictures = RunPictures((width, height), self._about.landmarks, self._zones)
        picture = draw_result(self._pictures, result, people, image)
        return self._encoder.encode(pad_to_even(picture), result.frame.time_s)

    def _end(self, outputs: Sequence[PacketOutput], error: Exception) -> None:
        for output in tuple(outputs):
            self._outputs.remove(output)
            output.discard()
            words = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
            self._notify("sink", f"{output.name} ends: {words}; the run goes on without it")


class OverlayFiles(PacketOutput):
    """Writes overlay.mp4, and after every ten minutes, or for pictures of another size, the next file overlay-2.mp4."""

    name = "overlay.mp4"

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._encoder: VideoEncoder | None = None

    def write(self, result: FrameResult, packets: Sequence[VideoPacket], encoder: VideoEncoder) -> None:
        """Add packets. Raise OSError if the disk refuses."""
        for packet in packets:
            file = self._file
            is_long = file is not None and packet.is_key and packet.pts - file.begin >= _PART_S * HZ
            if is_long or encoder is not self._encoder:
                self.close()
            if self._file is None:
                self._count, self._encoder = self._count + 1, encoder
                self.name = f"overlay-{self._count}.mp4" if self._count > 1 else self.name
                self._file = VideoFile(self._folder / self.name, encoder)
            self._file.write(packet)

    def close(self) -> None:
        """Move the file to its place. Raise OSError if the disk refuses."""
        if (file := self._file) is not None:
            file.close()
            self._file = None


class EventClips(PacketOutput):
    """Writes clips/000123-enter.mp4: some seconds before and after each event at a zone or of a crowd.

    The newest encoded pictures wait in memory, at most 32 MB. A clip with several events takes the name of the first,
    and lasts a minute at most. A clip that cannot be written gives an event; the next clip is tried.
    """

    name = "clips"

    def __init__(self, folder: Path, around_s: float, notify: Notify) -> None:
        """around_s: seconds before and after an event."""
        self._folder, self._around, self._notify = folder / "clips", round(around_s * HZ), notify
        self._groups = deque[list[VideoPacket]]()  # each begins with a key picture
        self._encoder: VideoEncoder | None = None
        self._end = 0

    def write(self, result: FrameResult, packets: Sequence[VideoPacket], encoder: VideoEncoder) -> None:
        """Take packets, and begin a clip for an event."""
        if encoder is not self._encoder:
            self.close()
            self._encoder = encoder
            self._groups.clear()
        for packet in packets:
            self._keep(packet)
            self._try(partial(self._add, packet))
        for event in result.events if self._groups else ():
            now = self._groups[-1][-1].pts
            lapse_s = result.time_s - event.time_s  # an event is certain some time after it happened
            at = now - round(min(max(lapse_s, 0.0), _SETTLED_S) * HZ) if math.isfinite(lapse_s) else now
            if self._file is None:
                self._try(partial(self._begin, f"{event.frame:06d}-{event.kind}.mp4", at))
            else:
                self._end = min(max(self._end, at + self._around), self._file.begin + round(_LONGEST_S * HZ))

    def close(self) -> None:
        """Complete the clip that is being written."""
        if (file := self._file) is not None:
            self._try(file.close)
            self._file = None

    def _keep(self, packet: VideoPacket) -> None:
        if packet.is_key or not self._groups:
            self._groups.append([])
        self._groups[-1].append(packet)
        while len(self._groups) > 1 and (
            self._groups[1][0].pts <= packet.pts - self._around - _SETTLED_S * HZ
            or sum(len(one.content) for group in self._groups for one in group) > _MOST_BYTES
        ):
            self._groups.popleft()

    def _begin(self, name: str, at: int) -> None:
        assert self._encoder is not None
        self._folder.mkdir(exist_ok=True)
        first = max((k for k, group in enumerate(self._groups) if group[0].pts <= at - self._around), default=0)
        self._file, self._end = VideoFile(self._folder / name, self._encoder, is_short=True), at + self._around
        for packet in chain.from_iterable(islice(self._groups, first, None)):
            self._add(packet)

    def _add(self, packet: VideoPacket) -> None:
        if self._file is not None and packet.pts > self._end:
            self.close()
        if self._file is not None:
            self._file.write(packet)

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except OSError as error:
            name = "a clip" if self._file is None else f"clips/{self._file.path.name}"
            self.discard()
            self._file = None
            self._notify("sink", f"{name} cannot be written: {error.strerror or error}; the next one is tried")


class SentPictures(PacketOutput):
    """Sends packets through a stream of `--emit video:`, which the session closes."""

    def __init__(self, stream: Stream, about: About) -> None:
        """about: the record that the recorder was given."""
        self.name, self._stream = stream.name, stream
        if stream.video is not None:
            stream.video.about = about

    def write(self, result: FrameResult, packets: Sequence[VideoPacket], encoder: VideoEncoder) -> None:
        """Send the packets of a result."""
        if self._stream.video is not None and packets:
            self._stream.video.packets, self._stream.video.encoder = packets, encoder
            self._stream.write(result)
