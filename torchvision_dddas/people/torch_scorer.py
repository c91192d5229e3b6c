"""Scores of windows by `nn.PersonScorer`: batched over pictures of one size, differentiable, on a CPU or GPU."""

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

# So many pixels of parts at once: about 150 bytes a pixel, and larger temporaries cost page faults on a CPU.
_PIXELS = {"cpu": 1 << 18, "cuda": 1 << 24}


class TorchScorer:
    """Implements `WindowScorer`."""

    name = "torch"

    def __init__(self, parameters: PeopleParameters, svm: LinearSvm, device: str | torch.device | None = None) -> None:
        """device: by default the GPU where there is one.

        Raises InputError where cells, blocks and window do not fit one another, or the SVM is of another length.
        """
        self.parameters, self.svm = parameters, svm
        self.device = torch.device(device or torch_device())
        self.layout = layout(parameters)
        if svm.weights.size != self.layout.features:
            raise InputError(
                f"the classifier {svm.origin} has {svm.weights.size} weights; "
                f"a window of these settings has {self.layout.features}"
            )
        weights = torch.from_numpy(np.array(svm.weights, np.float32))
        self.model = PersonScorer(weights, float(svm.bias), self.layout, parameters.window_stride_px).to(self.device)

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Sequence[Part]]) -> list[list[np.ndarray]]:
        """The score map of each part of each picture. Pictures of one size that want the same part share a batch."""
        maps = [
            [np.zeros(count_windows(part, self.parameters)[::-1], np.float32) for part in wanted] for wanted in parts
        ]
        places: dict[tuple[tuple[int, ...], Part], list[tuple[int, int]]] = defaultdict(list)
        for picture, wanted in enumerate(parts):
            for index, part in enumerate(wanted):
                if maps[picture][index].size:
                    places[images[picture].shape, part].append((picture, index))

        @cache  # a picture goes to the device once, for all its parts
        def levels(picture: int) -> Tensor:
            # A copy: torch warns of memory that must not be written to.
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
        """(B, ny, nx) scores of one part of pictures of one size, with gradients to their levels and to the weights.

        levels: (B, C, H, W) floats 0 .. 255, BGR.
        """
        width, height = part.level
        rows = F.reflect_index(torch.arange(part.y - 1, part.y + part.height + 1, device=levels.device), height)
        columns = F.reflect_index(torch.arange(part.x - 1, part.x + part.width + 1, device=levels.device), width)
        return self.model.score(F.resize(levels, (height, width), rows=rows, columns=columns, rounded=True))


def layout(parameters: PeopleParameters) -> F.Layout:
    """The descriptor of the settings. Raises InputError where they do not fit one another."""
    values: dict[str, Any] = parameters.descriptor
    return F.Layout(**values)
