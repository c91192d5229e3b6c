"""Three looks at once: which links are best in view of the next look (K = 3, with one interval of delay)."""

import numpy as np

from torchvision_dddas.tracking.triplets import good_columns

_LEAST = -2.0  # a link of a lower score is not made even if the next look speaks for it
_AHEAD = 0.8  # weight of the next look: at 1, a sharp turn is taken for a change of persons
_RIVALS = 6  # links of a track or a detection that are weighed against each other: more come only from stacked boxes
_TILT = 1e-6
_MOST_BRANCHES = 50  # of the exact solver; only boxes in stacks need more, and there one choice is as good as another


def plausible(links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The links (tracks, detections) worth following into the next look, from scores (N, M)."""
    tilted = _tilted(links)
    tracks, now = np.nonzero((links > _LEAST) & (_leading(tilted, _RIVALS) | _leading(tilted.T, _RIVALS).T))
    return tracks, now


def _tilted(score: np.ndarray) -> np.ndarray:
    """Scores (N, M) without ties: boxes that lie on each other have equal ones, and searching them all is endless."""
    rows, columns = score.shape
    return score - _TILT * ((np.arange(columns) - np.arange(rows)[:, None]) % max(columns, 1))


def _leading(score: np.ndarray, count: int) -> np.ndarray:
    """(N, M) whether a score is among the largest `count` of its row."""
    if score.shape[1] <= count:
        return np.ones(score.shape, bool)
    return score >= -np.partition(-score, count - 1, axis=1)[:, count - 1 : count]


def best_links(
    value: np.ndarray, tracks: np.ndarray, now: np.ndarray, onward: np.ndarray, born: np.ndarray, bridging: np.ndarray
) -> np.ndarray:
    """(P,) which links belong to the disjoint triplets with the largest sum of scores.

    value, tracks, now: (P,) the plausible links' scores, tracks and detections of this look. Scores to the L detections
    of the next look: onward (P, L) of the tracks after these links, born (M, L) of tracks that would begin here,
    bridging (N, L) of tracks not seen in this look, the (i, k) links that the source's eq. 4 and 5 leave out. Only the
    first layer is kept: the next look decides its own with its own follower.
    """
    onward, born, bridging = _tilted(onward), _tilted(born), _tilted(bridging)
    p, k = np.nonzero((onward > 0) & _leading(onward, _RIVALS))
    j, m = np.nonzero((born > 0) & _leading(born, _RIVALS))
    i, n = np.nonzero((bridging > 0) & _leading(bridging, _RIVALS))
    ends = np.cumsum([len(value), len(p), len(j), len(i)]).tolist()
    columns, score = np.full((ends[3], 3), -1), np.empty(ends[3])
    pair, triplet, late, bridge = (slice(a, b) for a, b in zip([0, *ends], ends, strict=False))
    columns[pair, 0], columns[pair, 1], score[pair] = tracks, now, value
    columns[triplet, 0], columns[triplet, 1], columns[triplet, 2] = tracks[p], now[p], k
    score[triplet] = value[p] + _AHEAD * onward[p, k]
    columns[late, 1], columns[late, 2], score[late] = j, m, _AHEAD * born[j, m]
    columns[bridge, 0], columns[bridge, 2], score[bridge] = i, n, _AHEAD * bridging[i, n]
    best, _ = good_columns(columns, score, _MOST_BRANCHES)
    chosen = np.zeros(len(value), bool)
    chosen[best[best < ends[0]]] = True
    chosen[p[best[(best >= ends[0]) & (best < ends[1])] - ends[0]]] = True
    return chosen
