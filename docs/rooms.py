"""Draws the order of the rooms: `python docs/rooms.py` writes rooms.svg from the order in tests/test_imports.py."""

import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WIDTH, HEIGHT, GAP = 720, 30, 8
FIELD_ROOMS = ("detection", "tracking", "people", "geo")
FIELDS, LABORATORY, OTHERS = "#cfe3f7", "#e9e1f5", "#f0f0ec"


def draw(order: Sequence[Sequence[str]]) -> str:
    """An SVG with a row for each floor, the lowest at the bottom. Fields are blue, the laboratory is violet."""
    height = len(order) * (HEIGHT + GAP) + GAP
    root = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    lines = [f'{root} font-family="sans-serif" font-size="14" text-anchor="middle">']
    lines += [f'<rect width="{WIDTH}" height="{height}" fill="white"/>']
    for floor, rooms in enumerate(order):
        y = height - (floor + 1) * (HEIGHT + GAP)
        pitch = (WIDTH - GAP) / len(rooms)
        for k, room in enumerate(rooms):
            fill = LABORATORY if room.startswith("lab") else FIELDS if room in FIELD_ROOMS else OTHERS
            x, wide = GAP + k * pitch, pitch - GAP
            place = f'x="{x:.0f}" y="{y}" width="{wide:.0f}" height="{HEIGHT}"'
            lines += [f'<rect {place} rx="4" fill="{fill}" stroke="#666"/>']
            lines += [f'<text x="{x + wide / 2:.0f}" y="{y + 20}">{room}</text>']
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    from tests.test_imports import ORDER

    (ROOT / "docs" / "rooms.svg").write_text(draw(ORDER), encoding="utf-8")
