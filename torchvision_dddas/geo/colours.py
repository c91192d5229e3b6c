"""Colours in pictures: masks of ranges of hue, saturation and value, their patches, and a search for such ranges."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import cheapest, occupied, shared_px
from torchvision_dddas.io.colour_files import find_overlaps
from torchvision_dddas.io.overlay import label, line_width, rectangle
from torchvision_dddas.types import Colours, Table

# Gaps in a patch up to about this width are closed: an antenna, a seam, a pixel of noise.
_CLOSE_PX = 5
_CLOSE_KERNEL = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSE_PX, _CLOSE_PX))
# Number of pixels processed together, chosen so that their planes stay in the cache. Processing one channel at a time
# takes 0.6 of the time of cv2.inRange on the whole picture, for eight colours at 1080p.
_PIXELS = 1 << 17

# Names of hues, in OpenCV's units.
HUES = {"red": 0, "orange": 13, "yellow": 28, "green": 60, "cyan": 90, "blue": 115, "purple": 136, "magenta": 155}
# Hue windows of the search: half width and step; then the lowest saturations and the lowest value.
_HALF, _STEP = 7, 4
_SATURATIONS, _VALUE = (80, 120, 160), 50
# Smallest fill of a patch's box; greatest length over width of the box; greatest share of the picture.
_FILL, _LONG, _MOST = 0.4, 3.0, 0.02
# A hue that covers a larger share of the picture than this belongs to the ground.
_GROUND = 0.05
# Least difference in hue between colours.
_APART = 10
# Area above which the size no longer raises the score, and the lowest score of a clear colour.
_AREA_PX, _CLEAR = 150.0, 0.24
# Margins in hue, saturation and value. The search takes the widest margin that marks the fewest other patches.
_MARGINS = ((8, 60, 80), (5, 60, 80), (2, 60, 80), (8, 40, 50), (5, 40, 50), (2, 40, 50), (4, 20, 25), (2, 10, 15))
_LOWEST = (40, 30)
_ENDS = (2, 98)


def mask_colours(image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return (K, H, W) uint8, 255 where the BGR image lies within a range of hue, saturation and value, else 0.

    low, high: (K, 3) in OpenCV's units (hue 0 to 180). A range whose lowest hue exceeds its highest wraps around 0. A
    grey picture has no colours. The results equal those of cv2.inRange.
    """
    masks = np.zeros((len(low), *image.shape[:2]), np.uint8)
    if image.ndim == 2 or not len(low) or not image.size:
        return masks
    rows = max(1, _PIXELS // image.shape[1])
    spare = np.empty((rows, image.shape[1]), np.uint8)
    for top in range(0, len(image), rows):
        hue, *rest = cv2.split(cv2.cvtColor(image[top : top + rows], cv2.COLOR_BGR2HSV))
        other = spare[: len(hue)]
        for mask, lowest, highest in zip(masks[:, top : top + rows], low, high, strict=True):
            if lowest[0] <= highest[0]:
                cv2.inRange(hue, float(lowest[0]), float(highest[0]), dst=mask)
            else:
                cv2.inRange(hue, float(lowest[0]), 255.0, dst=mask)
                cv2.bitwise_or(mask, cv2.inRange(hue, 0.0, float(highest[0]), dst=other), dst=mask)
            for plane, least, most in zip(rest, lowest[1:], highest[1:], strict=True):
                cv2.bitwise_and(mask, cv2.inRange(plane, float(least), float(most), dst=other), dst=mask)
    return masks


def to_hsv(image: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8 hue, saturation, value of a BGR picture."""
    return cv2.cvtColor(image, cv2.COLOR_BGR2HSV)


def mask_range(hsv: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return (H, W) uint8, 255 for pixels in a range. A range whose lowest hue exceeds its highest wraps around 0."""
    if low[0] <= high[0]:
        return cv2.inRange(hsv, np.asarray(low, float), np.asarray(high, float))
    below = cv2.inRange(hsv, np.asarray(low, float), np.array([180.0, *high[1:]]))
    return cv2.bitwise_or(below, cv2.inRange(hsv, np.array([0.0, *low[1:]]), np.asarray(high, float)))


@dataclass(frozen=True)
class Patches(Table):
    """The connected patches of one colour, one row a patch.

    centre_px: (P, 2) u, v of the centroid. area_px: (P,). box_px: (P, 4) x, y of the top left pixel, width, height.
    """

    centre_px: np.ndarray
    area_px: np.ndarray
    box_px: np.ndarray

    def __len__(self) -> int:
        return len(self.area_px)


def find_patches(mask: np.ndarray, least_area_px: int) -> Patches:
    """Close small gaps in a (H, W) uint8 mask, and return its patches (8-connected) of at least the given area."""
    parts = [Patches(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 4)))]
    for left, top, wide, high in occupied(mask, 2 * _CLOSE_PX):
        part = cv2.morphologyEx(mask[top : top + high, left : left + wide], cv2.MORPH_CLOSE, _CLOSE_KERNEL)
        count, _, stats, middles = cv2.connectedComponentsWithStats(part, ltype=cv2.CV_32S)
        large = 1 + np.flatnonzero(stats[1:count, cv2.CC_STAT_AREA] >= least_area_px)
        area = stats[large, cv2.CC_STAT_AREA].astype(float)
        parts.append(Patches(middles[large] + (left, top), area, stats[large, :4] + (left, top, 0.0, 0.0)))
    return Patches.concat(parts)


@dataclass(frozen=True)
class ColourSample:
    """A patch of a colour. hue: its mean hue. pixels: (P, 3) uint8 hue, saturation, value. score: in [0, 1].

    picture: index of its picture, from 0. box_px: x, y, width, height.
    """

    hue: float
    pixels: np.ndarray
    score: float
    picture: int
    box_px: tuple[int, int, int, int]


@dataclass(frozen=True)
class CalibratedColours:
    """The ranges of K colours, (K,) samples of each, best first, and (K,) the number of other patches in each range."""

    ranges: Colours
    groups: tuple[tuple[ColourSample, ...], ...]
    others: tuple[int, ...]


def calibrate_colours(
    images: Sequence[np.ndarray],
    least_area_px: int,
    count: int | None = None,
    names: Sequence[str] = (),
    boxes: Sequence[tuple[str, tuple[int, int, int, int]]] = (),
) -> CalibratedColours:
    """Find the colours of landmarks in (H, W, 3) uint8 BGR pictures that show all of them.

    count: number of colours; None: as many as names, or all clear colours. names: names in HUES get the nearest colour,
    others the rest by hue. boxes: (name, (x, y, width, height)) of each landmark in the first picture, used instead of
    a search. Raise InputError for a box without a strong colour, too few colours, or two similar colours.
    """
    hsv = [to_hsv(image) for image in images]
    if boxes:
        groups, names = [[_sample_box(hsv[0], name, box)] for name, box in boxes], [name for name, _ in boxes]
    else:
        groups = _search(hsv, least_area_px, count or len(names) or None)
        names = _match_names(names, [group[0].hue for group in groups])
    low, high, others = build_ranges(groups, hsv, least_area_px)
    for a, b in find_overlaps(low, high):
        raise InputError(
            f"the hues of {names[a]} and {names[b]} are too similar (about {low[a, 0]} and {low[b, 0]}); "
            "give the landmarks colours that differ more"
        )
    return CalibratedColours(Colours(tuple(names), low, high), tuple(map(tuple, groups)), tuple(others))


def _sample_box(hsv: np.ndarray, name: str, box_px: tuple[int, int, int, int]) -> ColourSample:
    """Return the most frequent saturated colour of a box."""
    (x, y, wide, high), (height, width) = box_px, hsv.shape[:2]
    if wide < 1 or high < 1 or x + wide > width or y + high > height:
        raise InputError(f"the box {x},{y},{wide},{high} of {name} is not inside the picture, {width} x {height} px")
    part = hsv[y : y + high, x : x + wide].reshape(-1, 3)
    vivid = part[(part[:, 1] >= _SATURATIONS[0]) & (part[:, 2] >= _VALUE)]
    if len(vivid) < max(4, len(part) // 10):
        raise InputError(f"nothing in the box {x},{y},{wide},{high} of {name} has a strong colour")
    count = np.bincount(vivid[:, 0] % 180, minlength=180).astype(float)
    around = np.convolve(np.r_[count[-_HALF:], count, count[:_HALF]], np.ones(2 * _HALF + 1), "valid")
    most = vivid[np.abs(hue_difference(vivid[:, 0], float(around.argmax()))) <= _HALF]
    return ColourSample(_mean_hue(most[:, 0]), most, 1.0, 0, box_px)


def _search(hsv: Sequence[np.ndarray], least_area_px: int, count: int | None) -> list[list[ColourSample]]:
    """Find colours in all pictures, group them by hue, and return the best `count` groups, or all clear groups."""
    samples = [sample for number, one in enumerate(hsv) for sample in _find_samples(one, least_area_px, number)]
    groups: list[list[ColourSample]] = []
    for sample in sorted(samples, key=lambda one: -one.score):
        near = [group for group in groups if abs(hue_difference(group[0].hue, sample.hue)) < _APART]
        if not near:
            groups.append([sample])
        elif all(one.picture != sample.picture for one in near[0]):
            near[0].append(sample)
    scores = [sum(one.score for one in group) for group in groups]
    best = sorted(range(len(groups)), key=lambda k: -scores[k])
    if count is None:
        best = [k for k in best if scores[k] >= _CLEAR * len(hsv)]
    if not best or (count is not None and len(best) < count):
        has = f"{len(best)} of {count} colours stand" if best else "no colour stands"
        where = "the picture" if len(hsv) == 1 else f"the {len(hsv)} pictures"
        raise InputError(f"{has} out in {where}; give a box of each landmark with --at NAME=X,Y,W,H")
    return sorted((groups[k] for k in best[:count]), key=lambda group: group[0].hue)


def _find_samples(hsv: np.ndarray, least_area_px: int, picture: int) -> list[ColourSample]:
    """Return compact saturated patches whose hue is rare in the picture, best first, one for each hue and place.

    The score of a patch is its share of all pixels of its hue and saturation, in the picture and around the patch.
    Ground and plants score low because their hues occur in many places.
    """
    found: list[ColourSample] = []
    counts = cv2.calcHist([hsv], [0, 1, 2], None, [180, 256, 2], [0, 180, 0, 256, _VALUE, 256 + 256 - _VALUE])[..., 0]
    for saturation in _SATURATIONS:
        for hue in range(0, 180, _STEP):
            window = np.arange(hue - _HALF, hue + _HALF + 1) % 180
            if counts[window, saturation:].sum() > _GROUND * hsv[..., 0].size:
                continue
            low = np.array([(hue - _HALF) % 180, saturation, _VALUE])
            mask = mask_range(hsv, low, np.array([(hue + _HALF) % 180, 255, 255]))
            total = int(np.count_nonzero(mask))
            if total < least_area_px:
                continue
            patches = find_patches(mask, least_area_px)
            # Keep patches that are as compact as a vehicle's plate.
            sides = patches.box_px[:, 2:]
            fill = patches.area_px / np.maximum(sides.prod(axis=1), 1)
            long = sides.max(axis=1, initial=1) / np.maximum(sides.min(axis=1, initial=1e9), 1)
            compact = (fill >= _FILL) & (long <= _LONG) & (patches.area_px <= _MOST * mask.size)
            found += [_sample(hsv, mask, patches, k, total, picture) for k in np.flatnonzero(compact).tolist()]
    kept: list[ColourSample] = []
    for sample in sorted(found, key=lambda sample: -sample.score):
        if all(
            abs(hue_difference(sample.hue, one.hue)) >= _APART
            and not shared_px(np.array(sample.box_px), np.array(one.box_px))
            for one in kept
        ):
            kept.append(sample)
    return kept


def _sample(hsv: np.ndarray, mask: np.ndarray, patches: Patches, k: int, total: int, picture: int) -> ColourSample:
    """Return the k-th patch of a mask that has `total` pixels in all."""
    x, y, width, height = (int(v) for v in patches.box_px[k])
    seen = hsv[y : y + height, x : x + width][mask[y : y + height, x : x + width] > 0]
    hue = _mean_hue(seen[:, 0])
    # The score is high for a colour that is rare in the picture and around the patch.
    around = np.count_nonzero(mask[max(y - height, 0) : y + 2 * height, max(x - width, 0) : x + 2 * width])
    share = (len(seen) / total) ** 0.5 * len(seen) / around * min(patches.area_px[k] / _AREA_PX, 1.0)
    # Add the middle of the box, including pixels that the window of hue and saturation left out.
    inner = hsv[y + height // 4 : y + height - height // 4, x + width // 4 : x + width - width // 4].reshape(-1, 3)
    alike = inner[(np.abs(hue_difference(inner[:, 0], hue)) <= _HALF) & (inner[:, 1] >= _SATURATIONS[0] // 2)]
    score = float(share * seen[:, 1].mean() / 255)
    return ColourSample(hue, np.concatenate([seen, alike]), score, picture, (x, y, width, height))


def build_ranges(
    groups: Sequence[Sequence[ColourSample]], pictures: Sequence[np.ndarray], least_area_px: int
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return lowest and highest hue, saturation and value (K, 3) int64, and the (K,) other patches in each range.

    pictures: (H, W, 3) uint8 in hue, saturation, value. Each range is widened as far as it marks no additional patches;
    hues are widened by at most half the gap to the next colour's hue.
    """
    middle = [group[0].hue for group in groups]
    ends = []
    for group, hue in zip(groups, middle, strict=True):
        pixels = np.concatenate([one.pixels for one in group]).astype(float)
        away = np.percentile(hue_difference(pixels[:, 0], hue), _ENDS)
        ends.append((*away, *np.percentile(pixels[:, 1:], _ENDS[0], axis=0)))
    chosen = []
    for k, (group, (below, above, saturation, value)) in enumerate(zip(groups, ends, strict=True)):
        # Limit the widening of a hue range to just under half the gap to the next colour's range.
        down, up = 90.0, 90.0
        for j in set(range(len(middle))) - {k}:
            gap = (middle[j] - middle[k]) % 180
            up = min(up, (gap + ends[j][0] - above - 1) / 2)
            down = min(down, (180 - gap - ends[j][1] + below - 1) / 2)
        tried = []
        for hue_margin, saturation_margin, value_margin in _MARGINS:
            first = int(np.ceil(middle[k] + below - min(hue_margin, down)))
            last = int(np.floor(middle[k] + above + min(hue_margin, up)))
            least = (max(saturation - saturation_margin, _LOWEST[0]), max(value - value_margin, _LOWEST[1]))
            low, high = [first % 180, *map(int, least)], [max(last, first) % 180, 255, 255]
            others = 0
            for number, hsv in enumerate(pictures):
                patches = find_patches(mask_range(hsv, np.array(low), np.array(high)), least_area_px)
                own = np.array([one.box_px for one in group if one.picture == number], float).reshape(-1, 4)
                others += int((shared_px(patches.box_px[:, None], own) == 0).all(axis=1).sum())
            tried.append((others, low, high))
            if others == 0:
                break
        chosen.append(min(tried, key=lambda one: one[0]))
    lowest, highest = (np.array([one[side] for one in chosen], np.int64) for side in (1, 2))
    return lowest, highest, [one[0] for one in chosen]


def _match_names(names: Sequence[str], hues: Sequence[float]) -> list[str]:
    """Return a name for each hue: the best fitting colour names, or the given names in the order of hue."""
    if names and not set(names) <= HUES.keys():
        return list(names)
    known = names or list(HUES)
    apart = np.array([[float(abs(hue_difference(HUES[name], hue))) for name in known] for hue in hues])
    if names:
        return [names[place] for place in cheapest(apart)[1].tolist()]
    words = [known[place] for place in apart.argmin(axis=1).tolist()]
    # Number the colours that share a name.
    return [word if words.count(word) == 1 else f"{word}-{words[: k + 1].count(word)}" for k, word in enumerate(words)]


def _mean_hue(hues: np.ndarray) -> float:
    return float(np.angle(np.exp(1j * np.pi * hues.astype(float) / 90).mean()) * 90 / np.pi % 180)


def hue_difference(hue: np.ndarray | float, other: float) -> np.ndarray:
    """Return the differences of hues from another hue, in [-90, 90)."""
    return (np.asarray(hue, float) - other + 90) % 180 - 90


def draw_calibration(images: Sequence[np.ndarray], found: CalibratedColours) -> bytes:
    """Return a PNG of all pictures, one below the other, that names each landmark.

    Pixels outside all ranges are grey. A range is outlined in its colour.
    """
    ranges = found.ranges
    # Each range gets a bright BGR colour with the hue at the middle of the range.
    low, high = ranges.low[:, 0], ranges.high[:, 0]
    vivid = np.full((1, len(low), 3), 255, np.uint8)
    vivid[0, :, 0] = (low + (high - low) % 180 / 2) % 180
    shades = [(b, g, r) for b, g, r in cv2.cvtColor(vivid, cv2.COLOR_HSV2BGR)[0].tolist()]
    sheets = []
    for number, image in enumerate(images):
        hsv = to_hsv(image)
        masks = np.stack([mask_range(hsv, *ends) for ends in zip(ranges.low, ranges.high, strict=True)])
        is_marked, thick = masks.any(axis=0), line_width(image)
        sheet = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) // 2 + 40, cv2.COLOR_GRAY2BGR)
        sheet[is_marked] = image[is_marked]
        for name, mask, shade, group in zip(ranges.names, masks, shades, found.groups, strict=True):
            grown = cv2.dilate(mask, np.ones((2 * thick + 1,) * 2, np.uint8))
            sheet[(grown > 0) & ~is_marked] = shade
            for sighting in group:
                if sighting.picture == number:
                    around = np.array(sighting.box_px, float) + 4 * thick * np.array([-1, -1, 2, 2])
                    rectangle(sheet, around, shade, thick)
                    label(sheet, around, name, shade)
        width = images[0].shape[1]
        sheets.append(cv2.resize(sheet, (width, max(round(sheet.shape[0] * width / sheet.shape[1]), 1))))
    return cv2.imencode(".png", np.concatenate(sheets))[1].tobytes()
