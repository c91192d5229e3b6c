"""Colours by `ops.hsv`, on a CPU or GPU."""

import numpy as np
import torch

from torchvision_dddas.ops import hsv


class TorchColours:
    """Implements `ColourFinder`."""

    name = "torch"

    def __init__(self, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """By `ops.hsv.within`, hard; a grey picture has no colours."""
        if image.ndim == 2 or not len(low):
            return np.zeros((len(low), *image.shape[:2]), np.uint8)
        with torch.inference_mode():
            pixels = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None]
            lowest, highest = (torch.as_tensor(np.asarray(x), dtype=torch.float32) for x in (low, high))
            found = hsv.within(hsv.from_bgr(pixels.float() / 255), lowest.to(self.device), highest.to(self.device))
            return (found[0] * 255).to(torch.uint8).cpu().numpy()
