"""Three looks at once: which links are best in view of the next look (K = 3, with one interval of delay)."""

import numpy as np

from torchvision_dddas.targets.columns import best_columns

_LEAST = -2.0  # a link of a lower score is not made even if the next look speaks for it
_AHEAD = 0.7  # weight of the next look: at 1, a sharp turn is taken for a change of persons


def plausible(links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The links (tracks, detections) worth following into the next look, from scores (N, M)."""
    tracks, now = np.nonzero(links > _LEAST)
    return tracks, now


def best_links(
    links: np.ndarray, tracks: np.ndarray, now: np.ndarray, onward: np.ndarray, born: np.ndarray, bridging: np.ndarray
) -> np.ndarray:
    """The pairs (track, detection), (K, 2), of the disjoint triplets with the largest sum of scores.

    links: (N, M) from tracks to this look. tracks, now: (P,) those `plausible`. Scores to the L detections of the next
    look: onward (P, L) of the tracks after these links, born (M, L) of tracks that would begin here, bridging (N, L) of
    tracks not seen in this look, the (i, k) links that the source's eq. 4 and 5 leave out. Only the first layer is
    kept: the next look decides its own with its own follower.
    """
    value = links[tracks, now]
    p, k = np.nonzero(onward > 0)
    j, m = np.nonzero(born > 0)
    i, n = np.nonzero(bridging > 0)
    columns = np.full((len(value) + len(p) + len(j) + len(i), 3), -1)
    score = np.empty(len(columns))
    at = np.cumsum([0, len(value), len(p), len(j), len(i)])
    columns[: at[1], 0], columns[: at[1], 1], score[: at[1]] = tracks, now, value
    columns[at[1] : at[2]] = np.stack([tracks[p], now[p], k], axis=1)
    score[at[1] : at[2]] = value[p] + _AHEAD * onward[p, k]
    columns[at[2] : at[3], 1], columns[at[2] : at[3], 2], score[at[2] : at[3]] = j, m, _AHEAD * born[j, m]
    columns[at[3] :, 0], columns[at[3] :, 2], score[at[3] :] = i, n, _AHEAD * bridging[i, n]
    worth = score > 0
    columns, score = columns[worth], score[worth]
    chosen = columns[best_columns(columns, score)]
    return chosen[(chosen[:, 0] >= 0) & (chosen[:, 1] >= 0), :2]
