"""Score windows by `nn.PersonScorer`: batched over pictures of equal size, differentiable, on a CPU or GPU."""

from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchvision_dddas.functional as F
from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.nn import PersonScorer
from torchvision_dddas.people.pyramid import count_windows
from torchvision_dddas.runtime import torch_device
from torchvision_dddas.types import LinearSvm, Part

# Pixels of parts that are scored at once, about 150 bytes a pixel. On a CPU larger temporaries cause page faults.
_PIXELS = {"cpu": 1 << 18, "cuda": 1 << 24}


class TorchScorer:
    """Implements `WindowScorer`."""

    name = "torch"

    def __init__(self, parameters: PeopleParameters, svm: LinearSvm, device: str | torch.device | None = None) -> None:
        """Load the scorer. device: by default the GPU if there is one.

        Raises InputError if cells, blocks and window do not fit together, or if the SVM has another length.
        """
        self.parameters, self.svm = parameters, svm
        self.device = torch.device(device or torch_device())
        self.layout = layout(parameters)
        if svm.weights.size != self.layout.features:
            raise InputError(
                f"the classifier {svm.origin} has {svm.weights.size} weights; "
                f"a window of these settings has {self.layout.features}; set people.* to its training layout"
            )
        weights = torch.from_numpy(np.array(svm.weights, np.float32))
        self.model = PersonScorer(
            weights, float(svm.bias), layout=self.layout, window_stride_px=parameters.window_stride_px
        ).to(self.device)

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """Return the score map of each part of each picture. Pictures of equal size and part share a batch."""
        maps = [
            [np.zeros(count_windows(part, self.parameters)[::-1], np.float32) for part in wanted] for wanted in parts
        ]
        places: dict[tuple[tuple[int, ...], Part], list[tuple[int, int]]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                if maps[picture][index].size:
                    places[images[picture].shape, part].append((picture, index))

        @cache  # copy a picture to the device once, for all its parts
        def levels(picture: int) -> Tensor:
            # Make a copy, because torch warns about read-only memory.
            channels = torch.tensor(np.ascontiguousarray(np.atleast_3d(images[picture])))
            return channels.to(self.device).permute(2, 0, 1).float().contiguous()

        for (_, part), where in places.items():
            some = max(1, _PIXELS.get(self.device.type, 1 << 22) // (part.width * part.height))
            for begin in range(0, len(where), some):
                chunk = where[begin : begin + some]
                with torch.inference_mode():
                    found = self.score(torch.stack([levels(picture) for picture, _ in chunk]), part)
                for (picture, index), scored in zip(chunk, found.cpu().numpy(), strict=True):
                    maps[picture][index] = scored
        return maps

    def score(self, levels: Tensor, part: Part) -> Tensor:
        """Return the (B, ny, nx) scores of one part in pictures of equal size.

        levels: (B, C, H, W) floats 0 .. 255, BGR. Gradients reach the levels and the weights.
        """
        width, height = part.level
        rows = F.reflect_index(torch.arange(part.y - 1, part.y + part.height + 1, device=levels.device), height)
        columns = F.reflect_index(torch.arange(part.x - 1, part.x + part.width + 1, device=levels.device), width)
        return self.model.score(F.resize(levels, (height, width), rows=rows, columns=columns, rounded=True))


def layout(parameters: PeopleParameters) -> F.Layout:
    """Return the descriptor layout of the settings. Raises InputError if its parameters do not fit together."""
    values: dict[str, Any] = parameters.descriptor
    return F.Layout(**values)
