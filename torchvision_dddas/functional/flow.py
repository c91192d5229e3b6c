"""Pyramidal Lucas-Kanade: find points of one frame in another (appendix B, step S2).

The results agree with cv2.calcOpticalFlowPyrLK. Kornia has no sparse tracker. Sampling patches by `grid_sample` in
every iteration takes 17-20 times OpenCV's time on a CPU. Here each point has a table of correlations at whole
displacements, computed once, and an iteration interpolates bilinearly in it. This takes 7-9 times OpenCV's time, and
4-5 times for few points with predicted places.
"""

import math
from copy import copy

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.functional.filters import pad_reflect, reflect_index
from torchvision_dddas.functional.soft import all_true, is_traced

Pyramid = list[Tensor]

# Half the side of the table that a CPU tries first. Most points stay in it, and it has a quarter of the entries.
_SMALL_REACH = 1
_POINTS_AT_ONCE = 500


def build_pyramid(
    input: Float[Tensor, "B C H W"],  # noqa: A002 (Kornia's name)
    max_level: int,
) -> Pyramid:
    """Return `max_level` pictures from full size, each half the previous: cv2.buildOpticalFlowPyramid (5-tap binomial).

    kornia.geometry.build_pyramid smooths alike, at the same border (`reflect`), but then interpolates between pixels.
    This function takes every other pixel and rounds odd sides up. Kornia's takes 5 to 11 times as long on a CPU
    (`python eval/speed.py operations`).

    >>> [tuple(level.shape) for level in F.build_pyramid(torch.rand(1, 1, 48, 64), 3)]
    [(1, 1, 48, 64), (1, 1, 24, 32), (1, 1, 12, 16)]
    """
    pictures = [input]
    for _ in range(max_level - 1):
        pictures.append(_halved(pictures[-1]))
    return pictures


def lucas_kanade(
    points: Float[Tensor, "B N 2"],
    pyramid_from: Pyramid,
    pyramid_to: Pyramid,
    guess: Float[Tensor, "B N 2"] | None = None,
    *,
    window_px: int = 21,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    min_eigen: float = 1e-4,
    reach_px: int = 4,
    rounds: int = 1,
) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """Return the points' places in the second frame, and whether each was found.

    guess: predicted places; by default the points' own. Tables reach reach_px around the start of a level. If a point
    leaves its table, a new table is made, up to `rounds` tables in all. With a good guess a reach of 2 suffices. A
    point is not found if it has too little texture (smaller eigenvalue per pixel below min_eigen, in OpenCV's unit),
    leaves its table, or lies outside the frame.

    >>> picture = F.gaussian_blur2d(torch.rand(1, 1, 64, 64), 7)
    >>> start = torch.tensor([[[30.0, 30.0]]])
    >>> end, found = F.lucas_kanade(start, F.build_pyramid(picture, 2), F.build_pyramid(picture.roll(3, -1), 2))
    >>> end.round(decimals=1), found
    (tensor([[[33., 30.]]]), tensor([[True]]))
    """
    place = points if guess is None else guess
    place = place / 2.0 ** (len(pyramid_from) - 1)
    found = torch.ones_like(points[..., 0], dtype=torch.bool)
    for level in reversed(range(len(pyramid_from))):
        patch = _FromPatch(pyramid_from[level], points / 2.0**level, window_px, min_eigen)
        settled = torch.zeros_like(found)
        for _ in range(rounds):
            active = patch.textured & ~settled
            moved, arrived = _descend(patch, pyramid_to[level], place, active, iterations, epsilon_px, reach_px)
            place = torch.where(active[..., None], moved, place)
            settled = settled | arrived
            if all_true(settled | ~patch.textured):
                break
        found = patch.textured & settled
        if level:
            place = place * 2.0
    height, width = pyramid_to[0].shape[-2:]
    limit = torch.tensor([width - 1.0, height - 1.0], dtype=place.dtype, device=place.device)
    return place, found & ((place >= 0) & (place <= limit)).all(-1)


def forward_backward(
    points: Float[Tensor, "B N 2"],
    pyramid_from: Pyramid,
    pyramid_to: Pyramid,
    guess: Float[Tensor, "B N 2"] | None = None,
    *,
    limit_px: float = 1.0,
    **settings: float,
) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """Track as `lucas_kanade`; a point is found only if tracking back ends within limit_px of its start.

    The backward guess uses the predicted displacement, not the known start. Otherwise the check would always pass.

    >>> picture = F.gaussian_blur2d(torch.rand(1, 1, 64, 64), 7)
    >>> start = torch.tensor([[[30.0, 30.0]]])
    >>> end, found = F.forward_backward(start, F.build_pyramid(picture, 2), F.build_pyramid(picture.roll(3, -1), 2))
    >>> end.round(decimals=1), found
    (tensor([[[33., 30.]]]), tensor([[True]]))
    """
    there, found = lucas_kanade(points, pyramid_from, pyramid_to, guess, **settings)  # type: ignore[arg-type]
    back_guess = None if guess is None else there - (guess - points)
    back, returned = lucas_kanade(there, pyramid_to, pyramid_from, back_guess, **settings)  # type: ignore[arg-type]
    return there, found & returned & ((back - points).square().sum(-1) <= limit_px**2)


class _FromPatch:
    """The data of a level's first frame around each point: gradients times the inverse structure tensor.

    gradients: (B, N, 2, window^2); their product with a grey patch is the displacement that the patch implies. target:
    (B, N, 2), the displacement of the first frame's own patch. textured: whether the tensor can be inverted.
    """

    def __init__(self, image: Tensor, points: Tensor, window: int, min_eigen: float) -> None:
        self.window = window
        frame = torch.arange(len(image), device=image.device)[:, None].expand(points.shape[:2])
        parts = [
            self._of_points(image, points[:, part], frame[:, part], min_eigen) for part in _parts(image, points.shape)
        ]
        self.gradients, self.target, self.textured = (torch.cat(column, 1) for column in zip(*parts, strict=True))

    def _of_points(
        self, image: Tensor, points: Tensor, frame: Tensor, min_eigen: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        window = self.window
        corner = points - (window - 1) / 2
        base = corner.detach().floor()
        # Read one more pixel on every side for the gradient, and one more to the right and below for the interpolation.
        grey = _gather(image, base.long() - 1, frame, window + 3)
        inside = _inside(image, base.long(), window + 1)
        across = grey[..., 2:] - grey[..., :-2]
        down = grey[..., 2:, :] - grey[..., :-2, :]
        along_u = torch.add((across[..., :-2, :] + across[..., 2:, :]) * 3.0, across[..., 1:-1, :], alpha=10.0)
        along_v = torch.add((down[..., :-2] + down[..., 2:]) * 3.0, down[..., 1:-1], alpha=10.0)
        # Like OpenCV, mirror grey levels outside the picture, and set gradients to zero there.
        slopes = torch.stack([along_u, along_v], 2) * (inside / 32.0)[:, :, None]
        planes = torch.cat([slopes, grey[..., 1:-1, 1:-1][:, :, None]], 2)
        part = (corner - base)[..., None, None, None, :]
        planes = torch.lerp(planes[..., :-1], planes[..., 1:], part[..., 0])
        planes = torch.lerp(planes[..., :-1, :], planes[..., 1:, :], part[..., 1]).flatten(3)
        gradients = planes[:, :, :2]
        products = gradients @ planes.mT
        uu, uv, vv = products[..., 0, 0], products[..., 0, 1], products[..., 1, 1]
        smaller = 0.5 * (uu + vv - ((uu - vv).square() + 4.0 * uv.square()).detach().sqrt())
        # OpenCV's unit: grey levels 0..255, Scharr sums 32 times the slope, scaled by 2^-20, per pixel.
        textured = smaller.detach() * (255.0**2 / 1024.0 / window**2) >= min_eigen
        determinant = torch.where(textured, uu * vv - uv * uv, torch.ones_like(uu))
        inverse = torch.stack([vv, -uv, -uv, uu], -1).unflatten(-1, (2, 2)) / determinant[..., None, None]
        return inverse @ gradients, (inverse @ products[..., 2:])[..., 0], textured

    def select(self, chosen: Tensor) -> "_FromPatch":
        """Return the data of the chosen points, as a batch of one."""
        part = copy(self)
        part.gradients, part.target = self.gradients[chosen][None], self.target[chosen][None]
        return part


def _descend(
    patch: _FromPatch, image: Tensor, start: Tensor, active: Tensor, iterations: int, epsilon_px: float, reach: int
) -> tuple[Tensor, Tensor]:
    """Take Newton steps of the active points from `start` in one table; return places, and whether each stayed in it.

    On a CPU, a small table suffices for most points. Points that leave it start again in a table of the full reach. The
    result is the same.
    """
    frame = torch.arange(len(image), device=image.device)[:, None].expand(active.shape)
    if image.device.type != "cpu" or is_traced():
        return _step_in_table(patch, image, start, frame, active, iterations, epsilon_px, reach)
    place, stayed = start, torch.zeros_like(active)
    for tried in dict.fromkeys((min(_SMALL_REACH, reach), reach)):
        left = active & ~stayed
        if not left.any():
            break
        some = (start[left][None], frame[left][None], left[left][None])
        moved, arrived = _step_in_table(patch.select(left), image, *some, iterations, epsilon_px, tried)
        place = place.masked_scatter(left[..., None], moved)
        stayed = stayed.masked_scatter(left, arrived)
    return place, stayed


def _step_in_table(
    patch: _FromPatch,
    image: Tensor,
    start: Tensor,
    frame: Tensor,
    active: Tensor,
    iterations: int,
    epsilon_px: float,
    reach: int,
) -> tuple[Tensor, Tensor]:
    """Do the work of `_descend` in tables of one reach. frame: index of the picture in which each point is searched."""
    corner = start - (patch.window - 1) / 2
    base = corner.detach().floor()
    span = 2 * reach + 2
    whole = base.long() - reach
    parts = _parts(image, start.shape)
    table = torch.cat([_table(patch.gradients[:, p], image, whole[:, p], frame[:, p], span) for p in parts], 1)
    # Keep places relative to the table's origin, so that a table index is a whole displacement.
    origin = base - reach
    place = corner - origin
    corners = torch.tensor([0, 1, span, span + 1], device=place.device)
    last = torch.zeros_like(place)
    for _ in range(iterations):
        whole = place.detach().floor().clamp(max=span - 2)
        part = place - whole
        columns, rows = whole.long().unbind(-1)
        index = (rows * span + columns)[..., None] + corners
        (left, above), (right, below) = (1.0 - part).unbind(-1), part.unbind(-1)
        weights = torch.stack([left * above, right * above, left * below, right * below], -1)
        seen = (weights[..., None, :] * table.gather(3, index[..., None, :].expand(-1, -1, 2, -1))).sum(-1)
        step = patch.target - seen
        length = step.detach()
        # A point ends at rest. If it swings between two places, it ends half-way, as in OpenCV.
        rest = length.square().sum(-1) <= epsilon_px**2
        swing = ((length + last).abs().amax(-1) < 0.01) & ~rest
        last = length
        share = active * (1.0 - 0.5 * swing)
        # Do not extrapolate: a point beyond the table waits at its edge, and the next table is centred there.
        place = (place + share[..., None] * step).clamp(0, span - 1)
        active = active & ~(rest | swing)
        if all_true(~active):
            break
    inside = ((place > 0) & (place < span - 1)).all(-1)
    return place + origin + (patch.window - 1) / 2, inside


def _table(gradients: Tensor, image: Tensor, corner: Tensor, frame: Tensor, span: int) -> Float[Tensor, "B N 2 T"]:
    """Return the displacement that the second frame's patch implies at each of span x span whole displacements."""
    area = gradients.shape[-1]
    window = math.isqrt(area)
    grey = _gather(image, corner, frame, window + span - 1)
    batch, count, side = grey.shape[:3]
    # Unfold only the columns. The rows of one displacement then lie together in memory, so that each is one strided
    # product. Use dimension 3, not -1: torch's older ONNX exporter mishandles a negative one.
    strips = grey.unfold(3, window, 1).transpose(2, 3).reshape(batch * count, span, side * window)
    rows = [gradients.flatten(0, 1) @ strips[..., shift * window : shift * window + area].mT for shift in range(span)]
    return torch.stack(rows, 2).reshape(batch, count, 2, span * span)


def _parts(image: Tensor, shape: torch.Size) -> list[slice]:
    """Return slices of the (B, N) points to process at once. On a CPU few fit, so that patches stay in the cache."""
    if image.device.type != "cpu" or is_traced():
        return [slice(None)]
    step = max(_POINTS_AT_ONCE // max(shape[0], 1), 1)
    return [slice(first, first + step) for first in range(0, max(shape[1], 1), step)]


def _gather(image: Tensor, corner: Tensor, frame: Tensor, side: int) -> Float[Tensor, "B N side side"]:
    """Gather the pixels from each whole corner (u, v) of a picture of the batch, mirrored outside."""
    height, width = image.shape[-2:]
    steps = torch.arange(side, device=image.device)
    columns = reflect_index(corner[..., :1] + steps, width)
    rows = reflect_index(corner[..., 1:] + steps, height) * width
    rows = rows + frame[..., None] * (height * width)
    return image.take(rows[..., :, None] + columns[..., None, :])


def _inside(image: Tensor, corner: Tensor, side: int) -> Float[Tensor, "B N side side"]:
    """Return 1 where the pixels from each corner lie in the picture, and 0 elsewhere."""
    steps = torch.arange(side, device=image.device)
    columns, rows = corner[..., :1] + steps, corner[..., 1:] + steps
    along_u = ((columns >= 0) & (columns < image.shape[-1])).to(image.dtype)
    along_v = ((rows >= 0) & (rows < image.shape[-2])).to(image.dtype)
    return along_v[..., :, None] * along_u[..., None, :]


def _halved(gray: Tensor) -> Tensor:
    padded = pad_reflect(gray, 2, 2, 2, 2)
    for dim in (-2, -1):
        size = (padded.shape[dim] - 3) // 2
        taps = [padded.narrow(dim, k, padded.shape[dim] - k) for k in range(5)]
        even = [tap[..., ::2, :] if dim == -2 else tap[..., ::2] for tap in taps]
        far, near, middle = (
            even[0].narrow(dim, 0, size) + even[4].narrow(dim, 0, size),
            even[1].narrow(dim, 0, size) + even[3].narrow(dim, 0, size),
            even[2].narrow(dim, 0, size),
        )
        padded = torch.add(torch.add(far, near, alpha=4.0), middle, alpha=6.0) / 16.0
    return padded
