"""The tests' synthetic clip, for scripts that want a small clip whose camera is known."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.synthetic_clip import LEAST_PX, RATE_HZ, SIZE, film_into, flight, render

__all__ = ["LEAST_PX", "RATE_HZ", "SIZE", "film_into", "flight", "render"]
