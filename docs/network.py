"""A small network on top of MotionSegmenter, learned from simulated clips with Kornia. No data needed; minutes.

.venv/bin/python docs/network.py
"""

from collections.abc import Sequence

import kornia.augmentation as augment
import numpy as np
import torch
from kornia.losses import dice_loss
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.lab.simulation import film, load_scenario
from torchvision_dddas.nn import MotionSegmenter

Clip = tuple[Tensor, Tensor]
"""Pictures (T, 3, H, W), RGB in [0, 1], and their true masks (T, 1, H, W)."""


def film_scene(seed: int, frames: int = 8, size_px: tuple[int, int] = (320, 240)) -> Clip:
    """A flight past bushes, trees and houses, which stand out of the plane; cars and people move."""
    draw = np.random.default_rng(seed).uniform
    scene = {
        "uav.altitude_m": draw(14, 24),
        "uav.pitch_deg": draw(28, 50),
        "uav.speed_m_s": draw(3, 8),
        "camera.hfov_deg": draw(20, 45),
        "world.trees_per_ha": draw(20, 120),
        "world.bushes_per_ha": draw(100, 400),
        "world.buildings": 4,
        "world.relief_m": 3,
    }
    scenario = load_scenario("demo", [f"{name}={value:.4g}" for name, value in scene.items()], seed)
    # What moves is known from the second frame on.
    images, masks = zip(*list(film(scenario, frames=frames + 1, size_px=size_px))[1:], strict=True)
    return to_clip(images, masks)


def to_clip(images: Sequence[np.ndarray], masks: Sequence[np.ndarray]) -> Clip:
    """Tensors of BGR pictures and masks as OpenCV has them."""
    pictures = torch.from_numpy(np.stack(images)[..., ::-1].copy()).permute(0, 3, 1, 2) / 255
    return pictures, torch.from_numpy(np.stack(masks) > 0)[:, None].float()


def evidence_maps(model: MotionSegmenter, clip: Tensor) -> Tensor:
    """(B * T, 4, H, W) of clips (B, T, 3, H, W): margin and evidence in noise units, texture, grey."""
    found = model(clip)
    grey = clip.mean(2, keepdim=True).flatten(0, 1)
    texture = F.mean_gradient((255 * grey).round()) / 64
    return torch.cat([found.margin.flatten(0, 1), found.evidence.flatten(0, 1), texture, grey], 1)


class Correction(nn.Module):
    """Adds to the margin what a small network sees in the maps, at a quarter of their resolution."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(6, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=2, dilation=2),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=4, dilation=4),
            nn.ReLU(),
            nn.Conv2d(width, 1, 1),
        )
        # At first nothing is added: the mask is the segmenter's.
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, maps: Tensor) -> Tensor:
        """The corrected margin (N, 1, H, W) of maps (N, 4, H, W); above 0 is foreground. H, W: multiples of 4."""
        margin, seen = maps[:, :1], maps.clamp(-4, 8)
        pooled = torch.cat([nn.functional.avg_pool2d(seen, 4), nn.functional.max_pool2d(seen[:, :2], 4)], 1)
        return margin + nn.functional.interpolate(self.layers(pooled), scale_factor=4, mode="bilinear")


def loss_of(margin: Tensor, truth: Tensor, softness: float = 0.7) -> Tensor:
    """Kornia's dice loss of background and foreground. softness: of the mask, noise units."""
    logit = margin / softness
    return dice_loss(torch.cat([-logit / 2, logit / 2], 1), truth[:, 0].long(), average="macro")


def alter(clip: Tensor, truth: Tensor) -> Clip:
    """Another light, blur and side of clips (B, T, 3, H, W) and their masks, alike in all frames; noise in each."""
    alike = augment.VideoSequential(
        augment.RandomHorizontalFlip(),
        augment.RandomVerticalFlip(p=0.2),
        augment.RandomBrightness((0.8, 1.2), p=0.8),
        augment.RandomContrast((0.7, 1.3), p=0.8),
        augment.RandomGaussianBlur((3, 3), (0.3, 1.0), p=0.3),
        data_format="BTCHW",
        same_on_frame=True,
    )
    clip, truth = augment.AugmentationSequential(alike, data_keys=["input", "mask"])(clip, truth)
    noisy = augment.RandomGaussianNoise(std=0.01, p=0.5)(clip.flatten(0, 1))
    return noisy.clamp(0, 1).view_as(clip), truth


def learn(
    clips: Sequence[Clip], steps: int = 80, window: int = 5, batch: int = 2
) -> tuple[MotionSegmenter, Correction]:
    """The segmenter's parameters and the network learn together from windows of the clips."""
    torch.manual_seed(0)
    model, correction = MotionSegmenter(softness=0.2), Correction()
    groups = [{"params": correction.parameters(), "lr": 3e-3}, {"params": model.parameters(), "lr": 1e-2}]
    descent = torch.optim.Adam(groups)
    for step in range(1, steps + 1):
        start = int(torch.randint(len(clips[0][0]) - window + 1, ()))
        chosen = [clips[k] for k in torch.randperm(len(clips))[:batch].tolist()]
        clip, truth = (torch.stack(part)[:, start : start + window] for part in zip(*chosen, strict=True))
        clip, truth = alter(clip, truth)
        loss = loss_of(correction(evidence_maps(model, clip)), truth.flatten(0, 1))
        descent.zero_grad()
        loss.backward()
        descent.step()
        if step % 10 == 0 or step == steps:
            print(f"step {step} of {steps}: loss {loss.item():.3f}", flush=True)
    return model, correction


def f_of(margin: Tensor, truth: Tensor) -> float:
    """F of all pixels of a clip."""
    found, true = margin > 0, truth > 0
    return 2 * float((found & true).sum()) / max(float(found.sum() + true.sum()), 1)


def main(scenes: int = 12, held: int = 5, steps: int = 80, size_px: tuple[int, int] = (320, 240)) -> None:
    clips = [film_scene(seed, size_px=size_px) for seed in range(scenes + held)]
    model, correction = learn(clips[:scenes], steps)
    for clip, truth in clips[scenes:]:
        with torch.no_grad():
            before = f_of(MotionSegmenter()(clip[None]).margin[0], truth)
            after = f_of(correction(evidence_maps(model, clip[None])), truth)
        print(f"F on a scene not learned from: {before:.3f} -> {after:.3f}")


if __name__ == "__main__":
    main()
