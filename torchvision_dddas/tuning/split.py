"""Which examples a step learns from, and which are only watched."""

from collections import Counter
from collections.abc import Sequence

import torch

from torchvision_dddas.tuning.family import Example


def parted(examples: Sequence[Example], watched: float, most: int) -> tuple[list[Example], list[Example]]:
    """The examples to learn from, and those to watch: of each clip its last ones.

    Of a clip of three and more at least one is learned from and one watched. most: to watch; of more, some that lie
    evenly among them. Neighbours in time are alike, so that a part in one piece tells more than single frames. Where no
    clip has three, or none is to be watched, all are learned from and watched.
    """
    clips: dict[str, list[Example]] = {}
    for example in examples:
        clips.setdefault(example.clip, []).append(example)
    learned, kept = list[Example](), list[Example]()
    for mine in clips.values():
        count = min(max(1, round(watched * len(mine))), len(mine) - 1) if watched and len(mine) >= 3 else 0
        learned += mine[: len(mine) - count]
        kept += mine[len(mine) - count :]
    kept = kept or learned
    if len(kept) > most:
        kept = [kept[i * len(kept) // most] for i in range(most)]
    return learned, kept


def batch_of(step: int, clips: Sequence[str], batch: int, seed: int) -> list[int]:
    """Which examples a step takes, from step 0; clips: of which clip each example is.

    Every clip has the same say, whatever number of its frames is labelled: all examples come in an order of chance,
    those of clips with fewer several times, then all in another order. It depends on nothing else, so that a descent
    can be taken up at any step.
    """
    batch = min(batch, len(clips))
    mine: dict[str, list[int]] = {}
    for place, clip in enumerate(clips):
        mine.setdefault(clip, []).append(place)
    count = len(mine) * max(len(places) for places in mine.values())
    first = step * batch
    orders: dict[int, list[int]] = {}
    found = []
    for place in range(first, first + batch):
        turn, here = divmod(place, count)
        if turn not in orders:
            orders[turn] = _order(list(mine.values()), seed, turn)
        found.append(orders[turn][here])
    return found


def shares(clips: Sequence[str]) -> list[float]:
    """What each example counts in a mean of which every clip has the same share; clips: of which clip each is."""
    count = Counter(clips)
    return [1 / (len(count) * count[clip]) for clip in clips]


def _order(clips: Sequence[Sequence[int]], seed: int, turn: int) -> list[int]:
    """A turn: as many examples of each clip as the largest has."""
    generator = torch.Generator().manual_seed((seed * 1_000_003 + turn) % 2**63)
    most = max(len(places) for places in clips)
    drawn = [
        places[i]
        for places in clips
        for i in [i for _ in range(-(-most // len(places))) for i in _shuffled(len(places), generator)][:most]
    ]
    return [drawn[i] for i in _shuffled(len(drawn), generator)]


def _shuffled(count: int, generator: torch.Generator) -> list[int]:
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order
