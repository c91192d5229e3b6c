"""Blobs found on the engine's device: what OpenCV's `find_regions` finds, and only their boxes come to the host.

Regions are labelled by Kornia's union-find, for all pictures of a batch at once; area, peak and box follow by scatter
operations. One table of numbers comes to the host, is gated there, and then all pictures that are wanted of the batch
come in one transfer: crops of the blobs' boxes, and the warped neighbours of frames with blobs, which dense flow needs.
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
from torchvision_dddas.detection.blobs import Box, Region, box_slices, leave_touching, make_blobs
from torchvision_dddas.detection.engine import Foreground


@dataclass(frozen=True)
class Components:
    """The connected regions (8 neighbours) of a batch of masks, in the order of their first 2 x 2 blocks.

    labels: 0, or the region's entry of `label`. The others have one entry a region: picture, box, pixels, peak.
    """

    labels: Int64[Tensor, "B 1 H W"]
    label: Int64[Tensor, " R"]
    picture: np.ndarray
    box: np.ndarray
    area_px: np.ndarray
    peak: np.ndarray

    def at(self, chosen: np.ndarray) -> "Components":
        """Some of the regions."""
        label = self.label[torch.from_numpy(chosen).to(self.label.device)]
        rows = (column[chosen] for column in (self.picture, self.box, self.area_px, self.peak))
        return Components(self.labels, label, *rows)


def label_components(mask: Bool[Tensor, "B 1 H W"], evidence: UInt8[Tensor, "B 1 H W"]) -> Components:
    """All regions of the masks, and their largest evidence."""
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
    weak: tuple[Tensor, Tensor] | None,
    small: Tensor | None,
    warped: tuple[Tensor, Tensor],
) -> list[Foreground]:
    """The foregrounds of windows of one structure, with their blobs.

    maps: core, evidence, wide and texture, (B, 1, H, W) uint8 as all others. weak: where the wide evidence is certain
    at half the resolution, and that evidence, of `DetectionChain.find_weak`; None where no weak blobs are wanted.
    settings: of windows that have none of their own.
    """
    core, near, wide, texture = maps
    given, unit = [window.settings or settings for window in windows], evidence_scale(settings)
    searched = [(core, near, 1, [True] * len(windows))]
    if weak is not None:
        searched.append((*weak, 2, [window.looks_both_ways for window in windows]))
    found: list[Components] = []
    asked: list[Tensor] = []
    for mask, evidence, scale, wanted in searched:
        parts = label_components(mask > 0, evidence)
        least_px = np.array([of_frame.gates.min_area_px for of_frame in given])[parts.picture]
        least = np.array([of_frame.difference.peak * unit for of_frame in given])[parts.picture]
        passed = np.array(wanted)[parts.picture] & (parts.area_px * scale**2 >= least_px) & (parts.peak >= least)
        found.append(parts.at(np.flatnonzero(passed)))
        asked += _cut_regions(found[-1], evidence) + _cut_boxes(found[-1], [near, wide, texture], scale)[0]
    shown = np.unique(np.concatenate([parts.picture for parts in found]))
    for_flow = bool(len(shown)) and (settings.persistence.on or settings.refine.on)
    for_history = settings.history.on and not (settings.persistence.on or settings.refine.on)
    if for_flow:
        asked += [picture[torch.from_numpy(shown).to(picture.device), 0] for picture in warped]
    asked += [picture[:, 0] for picture in ([core] if for_history else []) + ([] if small is None else [small])]
    arrived = iter(_fetch(asked))
    crops = [[next(arrived) for _ in range(5)] for _ in found]
    nothing = np.zeros(core.shape[-2:], np.uint8)
    others = {}
    if for_flow:
        others = dict(zip(shown.tolist(), zip(next(arrived), next(arrived), strict=True), strict=True))
    cores = next(arrived) if for_history else [nothing] * len(windows)
    smalls = [None] * len(windows) if small is None else list(next(arrived))
    foregrounds = []
    a, b = windows[0].near[-1]
    for number, (window, own) in enumerate(zip(windows, given, strict=True)):
        pictures = [np.zeros_like(nothing) for _ in range(3)]
        regions: list[list[Region]] = []
        for parts, (_, _, scale, _), cut in zip(found, searched, crops, strict=True):
            ends = np.cumsum(parts.box[:, 2] * parts.box[:, 3])
            regions.append([])
            for k in np.flatnonzero(parts.picture == number).tolist():
                box, large = _as_box(parts.box[k]), _as_box(parts.box[k] * scale)
                inside, seen = (_crop(line, int(ends[k]), box) for line in cut[:2])
                for picture, line in zip(pictures, cut[2:], strict=True):
                    picture[box_slices(large)] = _crop(line, int(ends[k]) * scale**2, large)
                regions[-1].append(Region(box, inside > 0, seen, float(parts.peak[k])))
        threshold, hull = own.difference.threshold * unit, own.morphology.hull
        blobs = make_blobs(regions[0], threshold, hull)
        if len(regions) > 1:
            blobs += leave_touching(make_blobs(regions[1], threshold, hull, scale=2), blobs, nothing.shape)
        warped_here = others.get(number, (nothing, nothing))
        offsets = window.offsets[a], window.offsets[b]
        one, other, gradient = pictures
        foregrounds.append(
            Foreground(cores[number], one, other, gradient, smalls[number], warped_here, (), offsets, blobs=blobs)
        )
    return foregrounds


def _as_box(row: np.ndarray) -> Box:
    x, y, width, height = row.tolist()
    return x, y, width, height


def _crop(line: np.ndarray, end: int, box: Box) -> np.ndarray:
    """The pixels of a box that end at a place of a line of crops."""
    return line[end - box[2] * box[3] : end].reshape(box[3], box[2])


def _cut_regions(parts: Components, evidence: Tensor) -> list[Tensor]:
    """(P,) uint8 of the pixels in the regions' boxes, box by box: which are the region's, and their evidence."""
    (labels, seen), region = _cut_boxes(parts, [parts.labels, evidence])
    return [(labels == parts.label[region]).to(torch.uint8), seen]


def _cut_boxes(parts: Components, pictures: Sequence[Tensor], scale: int = 1) -> tuple[list[Tensor], Tensor]:
    """(P,) of the pixels in the boxes, box by box, of each picture; and each pixel's region.

    scale: pixels of the pictures that are one of the boxes along either side.
    """
    device, (height, width) = pictures[0].device, pictures[0].shape[-2:]
    x, y, wide, high = scale * parts.box.T
    sizes = wide * high
    first = (parts.picture * height + y) * width + x
    table = np.stack([sizes, np.cumsum(sizes) - sizes, first, wide])
    size, start, corner, across = torch.from_numpy(table).to(device)
    region = torch.arange(len(sizes), device=device).repeat_interleave(size, output_size=int(sizes.sum()))
    step = torch.arange(len(region), device=device) - start[region]
    place = corner[region] + step // across[region] * width + step % across[region]
    return [picture.flatten()[place] for picture in pictures], region


def _fetch(pictures: Sequence[Tensor]) -> list[np.ndarray]:
    """Copies on the host, in one transfer."""
    lines = torch.cat([picture.flatten() for picture in pictures]).cpu().numpy()
    ends = np.cumsum([picture.numel() for picture in pictures])[:-1]
    return [line.reshape(picture.shape) for line, picture in zip(np.split(lines, ends), pictures, strict=True)]
