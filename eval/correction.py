"""Measure the gain by the network of docs/network.py: `python eval/correction.py [DATA]`.

The network learns from simulated scenes and is scored on other scenes. If DATA holds clips with frames/ and masks/ as
for eval/accuracy.py, it is also scored on these at half their size. Training and choices on real clips leave out the
scored clip. The figures are the same in every run on one machine.
"""

import copy
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import bench
import cv2
import kornia.augmentation as augment
import numpy as np
import torch
from clips import clips_in
from torch import Tensor

from torchvision_dddas.detection import detect_motion
from torchvision_dddas.lab.evaluation.metrics.truth import load_truth, read_mask
from torchvision_dddas.nn import MotionSegmenter

sys.path.insert(0, str(bench.ROOT / "docs"))
from network import Correction, evidence_maps, f_of, film_scene, learn, loss_of, to_clip

Row = dict[str, Any]
"""Figures of a clip."""
COLUMNS = {
    "segmenter": "segmenter",
    "detect": "`dddas detect`",
    "simulation": "network, simulation",
    "threshold": "threshold of the others",
    "real": "network, the others",
    "both": "network, simulation, then the others",
}
_EVERY = 5  # every fifth dense mask is used


class Labelled(NamedTuple):
    """The labelled frames of a clip: maps (N, 4, H, W) of the plain and the learned segmenter, masks (N, 1, H, W)."""

    plain: Tensor
    learned: Tensor
    truth: Tensor


def measure_correction(options: bench.Options) -> tuple[str, dict[str, Any]]:
    """Learn from simulated scenes. Score on other scenes, and on real clips left out in turn."""
    scenes = [film_scene(seed, size_px=bench.parse_size(options.size)) for seed in range(options.scenes + options.held)]
    bench.log(f"{len(scenes)} scenes are filmed")
    model, correction = learn(scenes[: options.scenes], options.steps)
    every = list(range(len(scenes[0][0])))
    rows = []
    for k, (clip, truth) in enumerate(scenes[options.scenes :], options.scenes):
        found = label(clip, truth, every, model)
        rows.append(score(f"scene {k}", clip, every, found, correction))
        if options.figure and k == options.scenes:
            draw_figure(options.figure, clip, found, correction)
    real = measure_real(options, model, correction) if options.data else []
    parameters = {name: value.item() for name, value in model.named_parameters()}
    weights = sum(weight.numel() for weight in correction.parameters())
    text = format_rows("Simulated scenes that nothing is learned from:", rows)
    if real:
        text += "\n\n" + format_rows("Real clips, each left out in turn:", real)
    return text, {"scenes": rows, "clips": real, "parameters": parameters, "weights": weights}


def measure_real(options: bench.Options, model: MotionSegmenter, correction: Correction) -> list[Row]:
    rows, clips = [], []
    for place in clips_in(options.data):
        if not (place / "masks").is_dir():
            continue
        clip, truth, at = read_clip(place, options.frames)
        clips.append(label(clip, truth, at, model))
        rows.append(score(place.name, clip, at, clips[-1], correction))
    fresh = Correction()
    for k, (row, left_out) in enumerate(zip(rows, clips, strict=True)):
        others = clips[:k] + clips[k + 1 :]
        plain, learned = [(c.plain, c.truth) for c in others], [(c.learned, c.truth) for c in others]
        row["offset"] = best_offset(plain)
        row["threshold"] = f_of(left_out.plain[:, :1] - row["offset"], left_out.truth)
        tuned, row["real_steps"] = fine_tune(fresh, plain, options.tuning_steps)
        row["real"] = mean_f(tuned, [(left_out.plain, left_out.truth)])
        tuned, row["both_steps"] = fine_tune(correction, learned, options.tuning_steps)
        row["both"] = mean_f(tuned, [(left_out.learned, left_out.truth)])
        bench.log(row)
    return rows


def read_clip(place: Path, frames: int) -> tuple[Tensor, Tensor, list[int]]:
    """Return the first frames of a clip at half size, the masks of labelled frames, and their indices."""
    images = [cv2.imread(str(path)) for path in sorted((place / "frames").iterdir())[:frames]]
    height, width = images[0].shape[:2]
    size = width // 8 * 4, height // 8 * 4  # the network works at a quarter of the size
    files = load_truth(place).masks
    at = sorted(n - 1 for n in files if n <= len(images))
    at = at[::_EVERY] if len(at) == len(images) else at
    masks = [cv2.resize(np.uint8(read_mask(files[k + 1]) > 0), size, interpolation=cv2.INTER_NEAREST) for k in at]
    return *to_clip([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images], masks), at


def label(clip: Tensor, truth: Tensor, at: list[int], model: MotionSegmenter) -> Labelled:
    with torch.no_grad():
        maps = [evidence_maps(which, clip[None])[at] for which in (MotionSegmenter(softness=model.softness), model)]
    return Labelled(*maps, truth)


def score(name: str, clip: Tensor, at: list[int], found: Labelled, correction: Correction) -> Row:
    row = {
        "clip": name,
        "segmenter": f_of(found.plain[:, :1], found.truth),
        "detect": f_of(detect(clip)[at], found.truth),
        "simulation": mean_f(correction, [(found.learned, found.truth)]),
    }
    bench.log(row)
    return row


def detect(clip: Tensor) -> Tensor:
    """Return masks (T, 1, H, W) of `dddas detect` with its defaults."""
    images = np.ascontiguousarray((255 * clip).round().byte().permute(0, 2, 3, 1).numpy()[..., ::-1])
    return torch.from_numpy(np.stack([scene.mask > 0 for scene in detect_motion(list(images))]))[:, None].float()


def fine_tune(start: Correction, clips: Sequence[tuple[Tensor, Tensor]], steps: int) -> tuple[Correction, int]:
    """Train on two thirds of the clips. Return the network and step number, of five, that are best on the others."""
    torch.manual_seed(0)
    watched, taught = clips[::3], [clip for k, clip in enumerate(clips) if k % 3]
    side = min(min(maps.shape[-2:]) for maps, _ in taught)
    cut = augment.AugmentationSequential(
        augment.RandomHorizontalFlip(), augment.RandomCrop((side, side)), data_keys=["input", "mask"]
    )
    correction = copy.deepcopy(start)
    descent = torch.optim.Adam(correction.parameters(), lr=2e-3)
    best, best_f, chosen = start, mean_f(start, watched), 0
    for step in range(1, steps + 1):
        parts = []
        for k in torch.randperm(len(taught))[:4].tolist():
            maps, truth = taught[k]
            frame = int(torch.randint(len(maps), ()))
            parts.append(cut(maps[frame : frame + 1], truth[frame : frame + 1]))
        maps, truth = (torch.cat(part) for part in zip(*parts, strict=True))
        descent.zero_grad()
        loss_of(correction(maps), truth).backward()
        descent.step()
        if step % max(steps // 4, 1) == 0 and (f := mean_f(correction, watched)) > best_f:
            best, best_f, chosen = copy.deepcopy(correction), f, step
    return best, chosen


def mean_f(correction: Correction, clips: Sequence[tuple[Tensor, Tensor]]) -> float:
    with torch.no_grad():
        return float(np.mean([f_of(correction(maps), truth) for maps, truth in clips]))


def best_offset(clips: Sequence[tuple[Tensor, Tensor]]) -> float:
    """Return the change of the threshold, in noise units, that is best on these clips."""
    offsets = np.arange(-2.5, 6.01, 0.5).tolist()
    return max(offsets, key=lambda offset: np.mean([f_of(maps[:, :1] - offset, truth) for maps, truth in clips]))


def format_rows(title: str, rows: Sequence[Row]) -> str:
    """Format F of each clip, and the gains over the segmenter alone."""
    names = [name for name in COLUMNS if name in rows[0]]
    table = [[row["clip"], *(f"{row[name]:.3f}" for name in names)] for row in rows]
    table.append(["mean", *(f"{np.mean([row[name] for row in rows]):.3f}" for name in names)])
    gains = (bench.format_gain([row[name] - row["segmenter"] for row in rows], 3) for name in names[1:])
    table.append(["gain, 95 % of draws of the clips", "", *gains])
    return title + "\n\n" + bench.format_table(["clip", *(COLUMNS[name] for name in names)], table)


def draw_figure(path: str, clip: Tensor, found: Labelled, correction: Correction) -> None:
    """Draw the middle frame of a clip with its true mask, the segmenter's mask and the corrected mask."""
    k = len(clip) // 2
    image = np.ascontiguousarray((255 * clip[k]).round().byte().permute(1, 2, 0).numpy()[..., ::-1])
    with torch.no_grad():
        masks = [found.truth[k, 0], found.plain[k, 0], correction(found.learned[k : k + 1])[0, 0]]
    orange = np.array([0, 90, 170])
    parts = [image, *(np.where((mask > 0).numpy()[..., None], image // 3 + orange, image) for mask in masks)]
    cv2.imwrite(path, np.vstack([np.hstack(parts[:2]), np.hstack(parts[2:])]), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    options = {
        "data": None,
        "--scenes": 12,
        "--held": 5,
        "--size": "320x240",
        "--steps": 80,
        "--frames": 20,
        "--tuning_steps": 40,
        "--figure": None,
    }
    bench.main(__doc__, {"": (measure_correction, options)})
