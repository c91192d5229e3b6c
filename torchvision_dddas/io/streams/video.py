"""The annotated pictures as an MPEG transport stream with MISB ST 0601 metadata, which hold the targets as ST 0903."""

import math
import time
from collections.abc import Sequence

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.io.streams.connections import open_connection
from torchvision_dddas.io.streams.messages import About
from torchvision_dddas.io.streams.outlets import DatagramOutlet, Outlet, open_datagrams
from torchvision_dddas.io.telemetry import VMTI, VmtiTarget, encode_flight, encode_vmti, mapped
from torchvision_dddas.io.video_packets import TransportStream, VideoEncoder, VideoPacket, check_encoder
from torchvision_dddas.types import AerialLocations, Flight, FrameResult, TrackedFrame

_PACKET_BYTES = 188
_USUAL_PACKETS = 7  # in a datagram
_BURST = 24  # datagrams at once, because the buffers of receivers are small
_FLAT_SINE = 0.01  # a camera that looks less below the horizon has no middle on the ground


class VideoMessages:
    """Encodes a result as datagrams of the stream.

    packets, encoder: those of its annotated picture. about: a thread of its own may put its own record here.
    """

    def __init__(self, about: About) -> None:
        self.packets: Sequence[VideoPacket] = ()
        self.encoder: VideoEncoder | None = None
        self.about = about
        self._of: VideoEncoder | None = None  # the encoder of the open stream

    def __call__(
        self, result: FrameResult | None, people: TrackedFrame | None = None, age_s: float = 0.0, most_bytes: int = 0
    ) -> list[bytes]:
        """Return the datagrams of a result; none for a result without a picture."""
        if result is None or self.encoder is None or not self.packets:
            return []
        if self.encoder is not self._of:
            self._of, self._stream = self.encoder, TransportStream(self.encoder)
        metadata = encode_result(result, self.about, self.encoder.size_px)
        content = self._stream.mux(self.packets, metadata, self.packets[0].pts)
        packets = min(most_bytes // _PACKET_BYTES, _USUAL_PACKETS) if most_bytes else _USUAL_PACKETS
        size = packets * _PACKET_BYTES
        return [content[place : place + size] for place in range(0, len(content), size)]


def encode_result(result: FrameResult, about: About, size_px: tuple[int, int]) -> bytes:
    """Return a local set of MISB ST 0601 with the camera's pose and the targets; no bytes without a known time.

    size_px: size of the picture. Quantities that the run does not know are left out.
    """
    utc_s = about.start_utc_s + result.time_s
    if about.utc(result.time_s) is None:
        return b""
    located, tracks = result.locations, result.tracks
    flight, further, centre_deg = _describe_camera(located, about)
    places: dict[int, tuple[float, float, float]] = {}
    if located is not None and (degrees := located.positions.lonlat_deg) is not None:
        heights = located.positions.above_ellipsoid_m.tolist()
        rows = zip(located.positions.target.tolist(), degrees.tolist(), heights, strict=True)
        places = {target: (place[0], place[1], height) for target, place, height in rows}
    unknown = (math.nan, math.nan, math.nan)
    targets = [
        VmtiTarget(identity, box, score, places.get(identity, unknown))
        for identity, box, score in zip(
            *(x.tolist() for x in (tracks.identity, tracks.box_px, tracks.score)), strict=True
        )
    ]
    further[VMTI] = encode_vmti(result.number, size_px, targets, about.source, centre_deg)
    return encode_flight(flight, utc_s, further)


def _describe_camera(
    located: AerialLocations | None, about: About
) -> tuple[Flight, dict[int, bytes], tuple[float, float]]:
    """Return the camera's pose, further items, and where on the ground the middle of the picture lies."""
    nan, camera = math.nan, about.camera
    if located is None or (pose := located.fix.pose) is None or camera is None:
        return Flight(nan), {}, (nan, nan)
    (heading, pitch, roll), up_m = pose.angles_rad, float(pose.place_m[2])
    reach_m = up_m / math.tan(pitch) if up_m > 0 and math.sin(pitch) > _FLAT_SINE else nan
    middle_m = pose.place_m[:2] + reach_m * np.array([math.sin(heading), math.cos(heading)])
    place, centre = [(nan, nan)] * 2
    if (origin := located.positions.origin_deg) is not None:
        place, centre = (tuple(one) for one in lonlat(np.stack([pose.place_m[:2], middle_m]), origin).tolist())
    view_rad = 2 * np.arctan(np.array(camera.size_px) / 2 / (np.array(camera.focal_px) * pose.focal))
    above_sea_m = about.plane_above_sea_m + up_m
    flight = Flight(up_m, nan, place, above_sea_m, heading, pitch, roll, float(view_rad[0]))
    further = {
        17: mapped(math.degrees(view_rad[1]), 0, 180, 2),
        21: mapped(up_m / math.sin(pitch) if math.isfinite(reach_m) else nan, 0, 5_000_000, 4),
        23: mapped(centre[1], -90, 90, 4, signed=True),
        24: mapped(centre[0], -180, 180, 4, signed=True),
        25: mapped(about.plane_above_sea_m, -900, 19000, 2),
        75: mapped(about.plane_above_ellipsoid_m + up_m, -900, 19000, 2),
    }
    return flight, further, centre


class _PacedDatagrams(DatagramOutlet):
    """Datagrams with pauses, for the thread of the recording, which may wait."""

    _count = 0

    def _send(self, message: bytes) -> None:
        super()._send(message)
        self._count += 1
        if self._count % _BURST == 0:
            time.sleep(0.001)


def open_video(place: str, asked: str) -> Outlet:
    """Open udp://HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT. Raise InputError and OSError."""
    check_encoder(asked)
    if place.partition(":")[0].lower() == "udp":
        return open_datagrams(place, asked, _PacedDatagrams)
    if place.lower().startswith(("tcp:", "tls:")):
        return open_connection(place, asked)
    raise InputError(f"{asked}: video goes to udp://HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT")
