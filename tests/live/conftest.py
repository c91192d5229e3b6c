"""What several tests of live runs share."""

import pytest

from torchvision_dddas.live.health import Health


@pytest.fixture
def health():
    """A health with every kind of content."""
    filled = Health()
    for name in ("captured", "dropped", "reconnects"):
        filled.count(name, 3)
    filled.gauge("every", 2)
    filled.gauge("rate_hz", float("nan"))
    for k in range(1, 101):
        filled.took("latency", k / 1000)
    filled.event("stream", 'lost <b>rtsp://x</b> "again"\n', 12)
    filled.event("load", "fewer keypoints")
    filled.result()
    filled.platforms = lambda: {
        'ugv "1"\n\\': {"state": "sends pictures", "captured": 40, "dropped": 2, "frames": 38, "weight": None}
    }
    return filled
