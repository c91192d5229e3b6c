"""Turn scored windows into people: suppress overlapping windows, and compute a body box and a probability each."""

import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.geometry import shared_px
from torchvision_dddas.types import Float, Int, People

# A factor slightly below 1, so that rounding never makes the shared area larger than the smaller box.
_WHOLE = 1 - 1e-9
# A body closer than this to the picture's border, in body heights, may be cut by it: twice the error of foot rows.
_NEAR = 0.05


def people_from_windows(
    window_px: Float[np.ndarray, "N 4"],
    margin: Float[np.ndarray, " N"],
    size: tuple[int, int],
    parameters: PeopleParameters,
) -> People:
    """Return the people that windows show, the best score first. size: (width, height) of the picture."""
    window_px, margin = np.asarray(window_px, float).reshape(-1, 4), np.asarray(margin, float)
    if parameters.suppression == "nms":
        boxes = body_boxes(window_px, parameters)
        kept = non_maximum_suppression(boxes, margin, parameters.overlap, parameters.contained)
        # Windows with high scores are the most accurate. The cube gives little weight to scores near the threshold.
        window_px = refine_boxes(window_px, (margin - parameters.threshold) ** 3, kept, parameters.settle)
        margin = margin[kept]
    else:
        if parameters.suppression == "opencv":
            window_px, margin = group_rectangles(window_px, margin, parameters.group, parameters.group_distance)
        order = np.argsort(-margin, kind="stable")
        window_px, margin = window_px[order], margin[order]
    box_px = body_boxes(window_px, parameters)
    return People(box_px, probability(margin, parameters), margin, is_cut(box_px, size), window_px)


def body_boxes(window_px: Float[np.ndarray, "N 4"], parameters: PeopleParameters) -> Float[np.ndarray, "N 4"]:
    """Return the body's box in each window, by ratios that were calibrated on true boxes."""
    x, y, width, height = window_px.T
    wide, tall = parameters.width_share * width, parameters.height_share * height
    return np.stack([x + (width - wide) / 2, y + parameters.feet_share * height - tall, wide, tall], axis=1)


def probability(margin: Float[np.ndarray, " N"], parameters: PeopleParameters) -> Float[np.ndarray, " N"]:
    """Return the probability that a window with this score shows a person (Platt scaling)."""
    odds = parameters.probability_slope * (margin - parameters.probability_even)
    return 1 / (1 + np.exp(-np.clip(odds, -50, 50)))


def is_cut(box_px: Float[np.ndarray, "N 4"], size: tuple[int, int]) -> np.ndarray:
    """Return (N,) bool: whether the picture's border cuts the body, or is so near that it may."""
    near = _NEAR * box_px[:, 3:]
    low, high = box_px[:, :2], box_px[:, :2] + box_px[:, 2:]
    return (low < near).any(axis=1) | (high > np.array(size) - near).any(axis=1)


def non_maximum_suppression(
    box_px: Float[np.ndarray, "N 4"], score: Float[np.ndarray, " N"], overlap: float, contained: float = 1.0
) -> Int[np.ndarray, " K"]:
    """Return the rows of the boxes to keep, best score first, and by row for equal scores.

    A box is dropped if its IoU with a better kept box exceeds `overlap`, or if both share more than `contained` of the
    smaller box. The second rule is needed because legs and heads score as small people inside the box of a person.
    """
    order = np.argsort(-np.asarray(score, float), kind="stable")
    box = np.asarray(box_px, float).reshape(-1, 4)[order]
    area = box[:, 2] * box[:, 3]
    left = np.ones(len(order), bool)
    kept = []
    for i in range(len(order)):
        if not left[i]:
            continue
        kept.append(i)
        rest = slice(i + 1, None)
        shared = shared_px(box[i], box[rest]) * _WHOLE
        left[rest] &= shared <= overlap * (area[i] + area[rest] - shared)
        left[rest] &= shared <= contained * np.minimum(area[i], area[rest])
    return order[np.array(kept, np.int64)]


def refine_boxes(
    box_px: Float[np.ndarray, "N 4"],
    weight: Float[np.ndarray, " N"],
    kept: Int[np.ndarray, " K"],
    overlap: float,
) -> Float[np.ndarray, "K 4"]:
    """Return the kept boxes, each replaced by the weighted mean of all boxes whose IoU with it is at least `overlap`.

    Windows lie on a grid with steps of 6 % of their height and of one scale; the best window of a person lies between
    several grid positions. The mean is taken over centres and logarithms of sizes. A kept box whose weights are all 0
    stays unchanged.
    """
    box_px, weight = np.asarray(box_px, float).reshape(-1, 4), np.asarray(weight, float)
    area = box_px[:, 2:].prod(axis=1)
    place = np.concatenate([box_px[:, :2] + box_px[:, 2:] / 2, np.log(box_px[:, 2:])], axis=1)
    mean = place[kept]
    for k, row in enumerate(kept):
        shared = shared_px(box_px[row], box_px)
        near = shared >= overlap * (area[row] + area - shared)
        total = weight[near].sum()
        if total > 0:
            mean[k] = weight[near] @ place[near] / total
    size = np.exp(mean[:, 2:])
    return np.concatenate([mean[:, :2] - size / 2, size], axis=1)


def group_rectangles(
    box_px: Float[np.ndarray, "N 4"], score: Float[np.ndarray, " N"], least: int, distance: float = 0.2
) -> tuple[Float[np.ndarray, "G 4"], Float[np.ndarray, " G"]]:
    """Group HOG detections like OpenCV, and return the mean box of each group, in whole pixels, and its best score.

    box_px: whole numbers. least: drop groups of at most this many boxes; 0 returns the input unchanged. distance: two
    boxes are alike if each of their four edges differs by at most this share of the mean of the smaller width and the
    smaller height. Chains of alike boxes form a group. A group inside another group is dropped if the other has more
    boxes and more than three, or if it has itself less than three boxes.
    Source: OpenCV, HOGDescriptor::groupRectangles (modules/objdetect, hog.cpp); detectMultiScale uses distance 0.2.
    """
    box_px, score = np.asarray(box_px, float), np.asarray(score, float)
    if least <= 0 or not len(box_px):
        return box_px, score
    label = _alike(box_px, distance)
    groups = int(label.max()) + 1
    number = np.bincount(label, minlength=groups)
    mean = np.stack([np.bincount(label, weights=part, minlength=groups) for part in box_px.T], axis=1)
    mean = np.rint(mean * (1.0 / number)[:, None])
    best = np.full(groups, -np.inf)
    np.maximum.at(best, label, score)
    large = number > least
    mean, best, number = mean[large], best[large], number[large]
    margin = np.rint(mean[:, 2:] * distance)
    inside = (
        (mean[:, None, :2] >= mean[None, :, :2] - margin).all(-1)
        & (mean[:, None, :2] + mean[:, None, 2:] <= mean[None, :, :2] + mean[None, :, 2:] + margin).all(-1)
        & ((number[None, :] > np.maximum(3, number[:, None])) | (number[:, None] < 3))
    )
    np.fill_diagonal(inside, False)
    stays = ~inside.any(axis=1)
    return mean[stays], best[stays]


def _alike(box_px: np.ndarray, distance: float, rows: int = 64) -> np.ndarray:
    """Return the (N,) group numbers of boxes, in the order in which the groups first appear."""
    from scipy.sparse import coo_array  # imported here because it takes 40 MB and only OpenCV's grouping needs it
    from scipy.sparse.csgraph import connected_components

    order = np.argsort(box_px[:, 3], kind="stable")
    box = box_px[order]
    low, high, height, around = box[:, :2], box[:, :2] + box[:, 2:], box[:, 3], box[:, 2:].sum(axis=1)
    # Alike boxes differ in height by at most twice the tolerance of an edge, which limits the pairs to compare.
    ends = np.searchsorted(height, height + distance * around, side="right")
    one, two = [], []
    for start in range(0, len(box), rows):  # process the table of pairs in strips, because it may be large
        here = slice(start, start + rows)
        others = slice(start, int(ends[here].max()))
        size = np.minimum(box[here, None, 2:], box[None, others, 2:])
        reach = distance * (size[..., 0] + size[..., 1]) * 0.5
        near = np.ones(reach.shape, bool)
        for edge in (*low.T, *high.T):
            near &= np.abs(edge[here, None] - edge[None, others]) <= reach
        i, j = np.nonzero(near)
        one.append(order[i + start])
        two.append(order[j + start])
    i, j = np.concatenate(one), np.concatenate(two)
    table = coo_array((np.ones(len(i), bool), (i, j)), shape=(len(box), len(box)))
    label = connected_components(table, directed=False)[1]
    _, first, of_label = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[of_label]
