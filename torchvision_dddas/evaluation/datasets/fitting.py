"""Whether a clip's pictures and its truth fit each other, seen before any work is done on it."""

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.picture_size import size_of
from torchvision_dddas.evaluation.datasets.pictures import frame_size
from torchvision_dddas.evaluation.datasets.record import Clip


def fitted(clip: Clip) -> Clip:
    """The clip as it is. Raises InputError: nothing to score, no pictures, other frames or sizes than its truth's."""
    truth = clip.truth
    if truth is None:
        if not clip.still:
            raise InputError(f"{clip.place} has no truth; nothing in it can be scored")
        if not clip.pictures:
            raise InputError(f"{clip.place} holds no pictures")
        return clip
    if not clip.pictures and (truth.kind != "boxes" or truth.tracks is None):
        raise InputError(f"{truth.place} is the truth of a clip without pictures; put them into {clip.place}")
    last = max(truth.frames, default=0)
    if clip.frames and truth.kind == "one target" and truth.length != clip.frames:
        raise InputError(
            f"{truth.place} has {truth.length} lines, but the clip {clip.frames} frames; wanted a line a frame"
        )
    if clip.pictures and clip.frames and last > clip.frames:
        raise InputError(
            f"{truth.place} labels frame {last}, but the clip has {clip.frames} frames; is it the same clip?"
        )
    if clip.pictures and clip.frames and truth.length > clip.frames:
        raise InputError(f"{truth.place} is of {truth.length} frames, but the clip has {clip.frames}; is it whole?")
    _check_sizes(clip)
    return clip


def _check_sizes(clip: Clip) -> None:
    """The first and the last mask beside the first picture; the others are seen when they are scored."""
    truth = clip.truth
    if truth is None or not truth.masks:
        return
    first = clip.pictures[0]
    size = frame_size(first)
    for mask in (truth.masks[truth.frames[0]], truth.masks[truth.frames[-1]]):
        found = size_of(mask)
        if found != size:
            raise InputError(
                f"{mask} is {found[0]}×{found[1]} pixels, but {first.name} {size[0]}×{size[1]}; "
                "wanted masks of the size of the pictures"
            )
