"""Find blobs on the torch engine's device, as `find_regions` does with OpenCV, and copy only their boxes to the host.

Kornia's union-find labels the regions of all pictures of a batch at once; scatter operations give their area, peak and
box. These numbers are copied to the host and gated there. Then one transfer copies all needed pixels: the crops of the
blobs' boxes, and the warped neighbours of frames with blobs for outlines.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int64, UInt8
from kornia.contrib import connected_components_union_find
from torch import Tensor

from torchvision_dddas.chain import Window, evidence_scale
from torchvision_dddas.config import Settings
from torchvision_dddas.detection.blobs import Box, Region, box_slices, make_blobs
from torchvision_dddas.detection.engine import Foreground


@dataclass(frozen=True)
class Components:
    """The R connected regions (8 neighbours) of a batch of masks, in the order of their first 2 x 2 blocks.

    labels: at each pixel 0, or the entry of `label` of its region. label, picture, box, area_px, peak: one row for each
    region; picture is the index in the batch.
    """

    labels: Int64[Tensor, "B 1 H W"]
    label: Int64[Tensor, " R"]
    picture: np.ndarray
    box: np.ndarray
    area_px: np.ndarray
    peak: np.ndarray

    def at(self, chosen: np.ndarray) -> "Components":
        """Return the regions with the given indices."""
        label = self.label[torch.from_numpy(chosen).to(self.label.device)]
        rows = (column[chosen] for column in (self.picture, self.box, self.area_px, self.peak))
        return Components(self.labels, label, *rows)


def label_components(mask: Bool[Tensor, "B 1 H W"], evidence: UInt8[Tensor, "B 1 H W"]) -> Components:
    """Label all regions of the masks, and measure their box, area and largest evidence."""
    labels = connected_components_union_find(mask)
    height, width = mask.shape[-2:]
    place = mask.flatten().nonzero()[:, 0]
    label, number = labels.flatten()[place].unique(return_inverse=True)
    u, v, picture = place % width, place // width % height, place // (width * height)
    of_pixels = torch.stack([picture, -u, -v, u, v, evidence.flatten()[place].long()])
    largest = torch.full((6, len(label)), -max(height, width), dtype=torch.int64, device=mask.device)
    largest = largest.scatter_reduce(1, number.expand(6, -1), of_pixels, "amax")
    area_px = torch.zeros_like(label).scatter_add(0, number, torch.ones_like(number))
    picture, left, top, right, bottom, peak, area_px = torch.cat([largest, area_px[None]]).cpu().numpy()
    box = np.stack([-left, -top, right + left + 1, bottom + top + 1], axis=1)
    return Components(labels, label, picture, box, area_px, peak)


def foregrounds_with_blobs(
    windows: Sequence[Window],
    settings: Settings,
    maps: tuple[Tensor, Tensor, Tensor, Tensor],
    small: Tensor | None,
    warped: tuple[Tensor, Tensor],
) -> list[Foreground]:
    """Return the foregrounds of windows of equal structure, with their blobs.

    maps: core, evidence, wide and texture. They, `small` and `warped` are (B, 1, H, W) uint8. settings: used for
    windows without settings of their own.
    """
    core, near, wide, texture = maps
    given, unit = [window.settings or settings for window in windows], evidence_scale(settings)
    parts = label_components(core > 0, near)
    least_px = np.array([of_frame.gates.min_area_px for of_frame in given])[parts.picture]
    least = np.array([of_frame.difference.peak * unit for of_frame in given])[parts.picture]
    parts = parts.at(np.flatnonzero((parts.area_px >= least_px) & (parts.peak >= least)))
    asked = _cut_regions(parts, near) + _cut_boxes(parts, [near, wide, texture])[0]
    shown = np.unique(parts.picture)
    for_outlines = bool(len(shown)) and settings.refine.on
    for_history = settings.history.on
    if for_outlines:
        asked += [picture[torch.from_numpy(shown).to(picture.device), 0] for picture in warped]
    asked += [picture[:, 0] for picture in ([core] if for_history else []) + ([] if small is None else [small])]
    arrived = iter(_fetch(asked))
    crops = [next(arrived) for _ in range(5)]
    nothing = np.zeros(core.shape[-2:], np.uint8)
    others = {}
    if for_outlines:
        others = dict(zip(shown.tolist(), zip(next(arrived), next(arrived), strict=True), strict=True))
    cores = next(arrived) if for_history else [nothing] * len(windows)
    smalls = [None] * len(windows) if small is None else list(next(arrived))
    foregrounds = []
    a, b = windows[0].near[-1]
    ends = np.cumsum(parts.box[:, 2] * parts.box[:, 3])
    for number, (window, own) in enumerate(zip(windows, given, strict=True)):
        pictures = [np.zeros_like(nothing) for _ in range(3)]
        regions: list[Region] = []
        for k in np.flatnonzero(parts.picture == number).tolist():
            box = _as_box(parts.box[k])
            inside, seen = (_crop(line, int(ends[k]), box) for line in crops[:2])
            for picture, line in zip(pictures, crops[2:], strict=True):
                picture[box_slices(box)] = _crop(line, int(ends[k]), box)
            regions.append(Region(box, inside > 0, seen, float(parts.peak[k])))
        blobs = make_blobs(regions, own.difference.threshold * unit, own.morphology.hull)
        warped_here = others.get(number, (nothing, nothing))
        offsets = window.offsets[a], window.offsets[b]
        one, other, gradient = pictures
        foregrounds.append(
            Foreground(cores[number], one, other, gradient, smalls[number], warped_here, offsets=offsets, blobs=blobs)
        )
    return foregrounds


def _as_box(row: np.ndarray) -> Box:
    x, y, width, height = row.tolist()
    return x, y, width, height


def _crop(line: np.ndarray, end: int, box: Box) -> np.ndarray:
    """Return the pixels of a box, (height, width), from a flat array of crops in which they end at `end`."""
    return line[end - box[2] * box[3] : end].reshape(box[3], box[2])


def _cut_regions(parts: Components, evidence: Tensor) -> list[Tensor]:
    """Return two (P,) uint8 tensors over the P pixels of the regions' boxes: 1 inside the region, and the evidence."""
    (labels, seen), region = _cut_boxes(parts, [parts.labels, evidence])
    return [(labels == parts.label[region]).to(torch.uint8), seen]


def _cut_boxes(parts: Components, pictures: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
    """Return the P pixels of the regions' boxes from each picture, (P,) each, and the index of each pixel's region."""
    device, (height, width) = pictures[0].device, pictures[0].shape[-2:]
    x, y, wide, high = parts.box.T
    sizes = wide * high
    first = (parts.picture * height + y) * width + x
    table = np.stack([sizes, np.cumsum(sizes) - sizes, first, wide])
    size, start, corner, across = torch.from_numpy(table).to(device)
    region = torch.arange(len(sizes), device=device).repeat_interleave(size, output_size=int(sizes.sum()))
    step = torch.arange(len(region), device=device) - start[region]
    place = corner[region] + step // across[region] * width + step % across[region]
    return [picture.flatten()[place] for picture in pictures], region


def _fetch(pictures: Sequence[Tensor]) -> list[np.ndarray]:
    """Copy pictures to the host in one transfer."""
    lines = torch.cat([picture.flatten() for picture in pictures]).cpu().numpy()
    ends = np.cumsum([picture.numel() for picture in pictures])[:-1]
    return [line.reshape(picture.shape) for line, picture in zip(np.split(lines, ends), pictures, strict=True)]
