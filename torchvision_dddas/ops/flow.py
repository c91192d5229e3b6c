"""Pyramidal Lucas-Kanade: where points of one frame are in another (METHOD S2; appendix B, S2).

Agrees with cv2.calcOpticalFlowPyrLK. kornia has no sparse tracker; sampling patches with `grid_sample` in every iteration
costs 17-20x OpenCV's time on a CPU, a correlation table per point 8-12x, 1.4x when sparse and predicted (MEASURED): the sums
that an iteration needs at a fractional displacement are bilinear mixes of the sums at whole displacements, made once.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .borders import reflected, reflected_index

Pyramid = list[Tensor]


def pyramid(gray: Float[Tensor, "B 1 H W"], levels: int) -> Pyramid:
    """`levels` pictures, full size first, each half the one before: cv2.buildOpticalFlowPyramid (5-tap binomial)."""
    pictures = [gray]
    for _ in range(levels - 1):
        pictures.append(_halved(pictures[-1]))
    return pictures


def track(
    points: Float[Tensor, "B N 2"],
    pyramid_from: Pyramid,
    pyramid_to: Pyramid,
    guess: Float[Tensor, "B N 2"] | None = None,
    window_px: int = 21,
    iterations: int = 30,
    epsilon_px: float = 0.01,
    min_eigen: float = 1e-4,
    reach_px: int = 3,
    rounds: int = 3,
) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """The points' places in the second frame, and which were found.

    guess: predicted places (default: they stay). Tables reach reach_px around a level's starting place and are made anew up to
    `rounds` times where a point left them; with a good guess reach 2 and one round do. Not found: too little texture (smaller
    eigenvalue per pixel below min_eigen, in OpenCV's unit), gone from the table or outside the second frame.
    """
    place = points if guess is None else guess
    place = place / 2.0 ** (len(pyramid_from) - 1)
    found = torch.ones_like(points[..., 0], dtype=torch.bool)
    for level in reversed(range(len(pyramid_from))):
        patch = _FromPatch(pyramid_from[level], points / 2.0**level, window_px, min_eigen)
        settled = torch.zeros_like(found)
        for _ in range(rounds):
            moved, arrived = _descend(patch, pyramid_to[level], place, settled, iterations, epsilon_px, reach_px)
            place = torch.where((patch.textured & ~settled)[..., None], moved, place)
            settled = settled | arrived
            if _all_true(settled | ~patch.textured):
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
    limit_px: float = 1.0,
    **settings: float,
) -> tuple[Float[Tensor, "B N 2"], Bool[Tensor, "B N"]]:
    """As `track`; found only where tracking back returns to within limit_px of the start. settings: those of `track`.

    The way back is predicted by the same displacement as the way there, so that the start itself is not given away.
    """
    there, found = track(points, pyramid_from, pyramid_to, guess, **settings)  # type: ignore[arg-type]
    back_guess = None if guess is None else there - (guess - points)
    back, returned = track(there, pyramid_to, pyramid_from, back_guess, **settings)  # type: ignore[arg-type]
    return there, found & returned & ((back - points).square().sum(-1) <= limit_px**2)


class _FromPatch:
    """What a level needs of the first frame around each point: grey, its gradients, and the inverse structure tensor."""

    def __init__(self, image: Tensor, points: Tensor, window: int, min_eigen: float) -> None:
        self.window = window
        corner = points - (window - 1) / 2
        base = corner.detach().floor()
        # One pixel more on every side for the gradient, one more to the right and below for the interpolation.
        grey, outside = _gather(image, base.long() - 1, window + 3)
        across = grey[..., 2:] - grey[..., :-2]
        down = grey[..., 2:, :] - grey[..., :-2, :]
        along_u = torch.add((across[..., :-2, :] + across[..., 2:, :]) * 3.0, across[..., 1:-1, :], alpha=10.0) / 32.0
        along_v = torch.add((down[..., :-2] + down[..., 2:]) * 3.0, down[..., 1:-1], alpha=10.0) / 32.0
        inner = outside[..., 1:-1, 1:-1]
        planes = torch.stack([grey[..., 1:-1, 1:-1], along_u.masked_fill(inner, 0.0), along_v.masked_fill(inner, 0.0)], 2)
        part = (corner - base)[..., None, None, None, :]
        planes = torch.lerp(planes[..., :-1], planes[..., 1:], part[..., 0])
        planes = torch.lerp(planes[..., :-1, :], planes[..., 1:, :], part[..., 1])
        flat = planes.flatten(3)
        self.gradients = flat[:, :, 1:]
        # Products of grey and both gradients with both gradients, in one go.
        products = flat @ self.gradients.mT
        uu, uv, vv = products[:, :, 1, 0], products[:, :, 1, 1], products[:, :, 2, 1]
        smaller = 0.5 * (uu + vv - torch.sqrt(((uu - vv).square() + 4.0 * uv.square()).clamp(min=1e-24)))
        # OpenCV's unit: grey levels 0..255, Scharr sums 32 times the slope, scaled by 2^-20, per pixel.
        self.textured = smaller.detach() * (255.0**2 / 1024.0 / window**2) >= min_eigen
        determinant = torch.where(self.textured, uu * vv - uv * uv, torch.ones_like(uu))
        self.inverse = torch.stack([torch.stack([vv, -uv], -1), torch.stack([-uv, uu], -1)], -2) / determinant[..., None, None]
        self.target = products[:, :, :1] @ self.inverse


def _descend(
    patch: _FromPatch, image: Tensor, start: Tensor, settled: Tensor, iterations: int, epsilon_px: float, reach: int
) -> tuple[Tensor, Tensor]:
    """Newton steps from `start` inside one table: the places reached, and whether each came to rest within it."""
    corner = start - (patch.window - 1) / 2
    base = corner.detach().floor()
    span = 2 * reach + 2
    table = _table(patch, image, base.long() - reach, span)
    # Places are kept relative to the table's origin, where a table index is a whole displacement.
    origin = base - reach
    place = corner - origin
    active = ~settled
    last = torch.zeros_like(place)
    for number in range(iterations):
        whole = place.detach().floor().clamp(0, span - 2)
        part = place - whole
        index = (whole[..., 1] * span + whole[..., 0]).long()[..., None]
        right, below = part[..., :1], part[..., 1:]
        corners = torch.cat([index, index + 1, index + span, index + span + 1], -1)[..., None].expand(-1, -1, -1, 2)
        across = torch.cat([1.0 - right, right], -1)
        weights = torch.cat([across * (1.0 - below), across * below], -1)
        seen = (weights[..., None] * table.gather(2, corners)).sum(2)
        step = patch.target[:, :, 0] - seen
        rest = step.detach().square().sum(-1) <= epsilon_px**2
        if number:
            # OpenCV's way out of a two-step oscillation: stop half-way.
            swing = ((step + last).detach().abs() < 0.01).all(-1) & ~rest
            step = torch.where(swing[..., None], 0.5 * step, step)
            rest = rest | swing
        place = torch.where(active[..., None], place + step, place)
        last = step
        # Beyond the table bilinear mixing would extrapolate: leave the rest to the next table, which is centred here.
        lost = ((place < 0) | (place > span - 1)).any(-1).detach()
        active = active & ~rest & ~lost
        if _all_true(~active):
            break
    inside = ((place >= 0) & (place <= span - 1)).all(-1).detach()
    place = place.clamp(0, span - 1)
    return place + origin + (patch.window - 1) / 2, inside & ~active


def _table(patch: _FromPatch, image: Tensor, corner: Tensor, span: int) -> Float[Tensor, "B N T 2"]:
    """Step that the second frame asks for at every whole displacement: inverse tensor times sum of grey x gradient."""
    window = patch.window
    grey, _ = _gather(image, corner, window + span - 1)
    batch, count, side = grey.shape[:3]
    # Columns unfolded, rows not: rows of one displacement lie together in memory, so each is one strided product.
    strips = grey.unfold(-1, window, 1).transpose(2, 3).reshape(batch * count, span, side * window)
    weights = (patch.gradients.mT @ patch.inverse).flatten(0, 1)
    area = window * window
    rows = [strips[..., shift * window : shift * window + area] @ weights for shift in range(span)]
    return torch.stack(rows, 1).reshape(batch, count, span * span, 2)


def _gather(image: Tensor, corner: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """side x side pixels from each whole corner (u, v), mirrored outside the picture, and where they are outside."""
    batch, _, height, width = image.shape
    steps = torch.arange(side, device=image.device)
    columns, rows = corner[..., :1] + steps, corner[..., 1:] + steps
    outside = ((rows < 0) | (rows >= height))[..., :, None] | ((columns < 0) | (columns >= width))[..., None, :]
    columns, rows = reflected_index(columns, width), reflected_index(rows, height)
    frame = torch.arange(batch, device=image.device).reshape(-1, 1, 1) * (height * width)
    index = (rows * width + frame)[..., :, None] + columns[..., None, :]
    return image.reshape(-1)[index], outside


def _halved(gray: Tensor) -> Tensor:
    padded = reflected(gray, 2, 2)
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


def _all_true(condition: Tensor) -> bool:
    """Whether to stop early: only where asking is cheap and the graph is not being traced; results are the same."""
    return condition.device.type == "cpu" and not torch.compiler.is_compiling() and bool(condition.all())
