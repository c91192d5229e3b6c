"""Many clips advanced together, so that their frames can be processed as one batch."""

from collections.abc import Iterator, Sequence

from torchvision_dddas.errors import InputError
from torchvision_dddas.sources.source import Source
from torchvision_dddas.types import Frame


def lockstep(sources: Sequence[Source]) -> Iterator[list[Frame | None]]:
    """One list a step: each clip's frame of that number, or None where it was lost or the clip has ended.

    Step n holds only frames numbered n, so that windows of one batch span the same frames. Ends with the longest clip.
    Raises InputError when the clips differ in size, naming those that differ from the first.
    """
    if not sources:
        raise InputError("no clips were given to read together")
    width, height = sources[0].size
    odd = [
        f"{source.name} is {source.size[0]}x{source.size[1]}" for source in sources if source.size != (width, height)
    ]
    if odd:
        raise InputError(
            f"clips read together must have one size: {sources[0].name} is {width}x{height} but {', '.join(odd)}"
        )
    return _advance(sources)


def _advance(sources: Sequence[Source]) -> Iterator[list[Frame | None]]:
    clips = [iter(source) for source in sources]
    waiting = [next(clip, None) for clip in clips]
    number = 1
    while any(waiting):
        batch = [frame if frame and frame.number == number else None for frame in waiting]
        waiting = [next(clip, None) if now else frame for clip, now, frame in zip(clips, batch, waiting, strict=True)]
        yield batch
        number += 1
