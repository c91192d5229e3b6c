"""Which examples a step learns from, and which are only watched."""

from collections.abc import Sequence

import torch

from torchvision_dddas.tuning.family import Example


def parted(examples: Sequence[Example], watched: float, most: int) -> tuple[list[Example], list[Example]]:
    """The examples to learn from, and those to watch: of each clip its last ones, of three and more at least one.

    most: to watch; of more, some that lie evenly among them. Neighbours in time are alike, so that a part in one piece
    tells more than single frames. Where no clip has three, or none is to be watched, all are learned from and watched.
    """
    clips: dict[str, list[Example]] = {}
    for example in examples:
        clips.setdefault(example.clip, []).append(example)
    learned, kept = list[Example](), list[Example]()
    for mine in clips.values():
        count = max(1, round(watched * len(mine))) if watched and len(mine) >= 3 else 0
        learned += mine[: len(mine) - count]
        kept += mine[len(mine) - count :]
    kept = kept or learned
    if len(kept) > most:
        kept = [kept[i * len(kept) // most] for i in range(most)]
    return learned, kept


def batch_of(step: int, count: int, batch: int, seed: int) -> list[int]:
    """Which of `count` examples a step takes, from step 0: all in an order of chance, then all in another.

    It depends on nothing else, so that a descent can be taken up at any step.
    """
    batch = min(batch, count)
    first = step * batch
    orders: dict[int, list[int]] = {}
    found = []
    for place in range(first, first + batch):
        turn, here = divmod(place, count)
        if turn not in orders:
            orders[turn] = _order(count, seed, turn)
        found.append(orders[turn][here])
    return found


def _order(count: int, seed: int, turn: int) -> list[int]:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + turn) % 2**63)
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order
