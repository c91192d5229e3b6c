"""Colours by `ops.hsv`, on a CPU or GPU."""

import numpy as np
import torch

from torchvision_dddas.functional import hsv


class TorchColourFinder:
    """Implements `ColourFinder`."""

    name = "torch"

    def __init__(self, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one."""
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def masks(self, image: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """By `ops.hsv.within`, hard; a grey picture has no colours.

        Hue and saturation are not rounded before they are compared but as they are: OpenCV's 8-bit conversion is up to
        0.64 of a level off, and a pixel next to a bound may fall to the other side.
        """
        if image.ndim == 2 or not len(low) or not image.size:
            return np.zeros((len(low), *image.shape[:2]), np.uint8)
        with torch.inference_mode():
            pixels = torch.from_numpy(np.ascontiguousarray(image)).to(self.device).permute(2, 0, 1)[None]
            lowest, highest = (torch.from_numpy(np.array(bound, np.float32)).to(self.device) for bound in (low, high))
            found: np.ndarray = (
                (hsv.within(hsv.from_bgr(pixels.float() / 255), lowest, highest)[0] * 255).byte().cpu().numpy()
            )
        return found
