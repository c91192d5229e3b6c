"""Edge-aware spreading of evidence: the recursive domain transform (Gastal and Oliveira 2011)."""

import numpy as np


def spread(
    evidence: np.ndarray, guide: np.ndarray, spatial_px: float, colour_levels: float, rounds: int = 2
) -> np.ndarray:
    """Smooth (H, W, K) evidence along a picture's flat regions, without crossing its edges.

    guide: (H, W, 3) or (H, W) uint8. spatial_px: reach where the colour does not change. colour_levels: change of
    colour, summed over the channels, that counts as much as that reach.
    """
    colours = np.atleast_3d(guide).astype(np.float32)
    colours *= 3 / colours.shape[2]  # a grey picture is one of three equal channels
    across = 1 + spatial_px / colour_levels * np.abs(np.diff(colours, axis=1)).sum(axis=2)
    down = 1 + spatial_px / colour_levels * np.abs(np.diff(colours, axis=0)).sum(axis=2)
    # Rows are made contiguous for either direction: each step then works on whole rows.
    rows = np.ascontiguousarray(evidence, np.float32)
    for i in range(rounds):
        sigma = spatial_px * np.sqrt(3) * 2 ** (rounds - i - 1) / np.sqrt(4**rounds - 1)
        decay = np.log(np.float32(np.exp(-np.sqrt(2) / sigma)))
        columns = np.ascontiguousarray(rows.transpose(1, 0, 2))
        _sweep(columns, np.exp(decay * across).T)
        rows = np.ascontiguousarray(columns.transpose(1, 0, 2))
        _sweep(rows, np.exp(decay * down))
    return rows


def _sweep(lines: np.ndarray, keep: np.ndarray) -> None:
    """There and back over the first axis: each line takes the share `keep` from the line before it."""
    keep = np.ascontiguousarray(keep)[:, :, None]
    for i in range(1, len(lines)):
        lines[i] += keep[i - 1] * (lines[i - 1] - lines[i])
    for i in range(len(lines) - 2, -1, -1):
        lines[i] += keep[i] * (lines[i + 1] - lines[i])
