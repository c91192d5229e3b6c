"""Records of several views: shared identities, and the map from one view to another."""

from dataclasses import dataclass

import numpy as np

from torchvision_dddas.types.ground import Positions
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.tracks import Tracks


@dataclass(frozen=True)
class ViewMap(Record):
    """The registration of two views at a frame.

    b_from_a: (3, 3) homography over the ground between pixels, or between metres; None: unknown.
    quality: share in [0, 1] of the targets in both views that have a partner, averaged over the last frames.

    >>> td.ViewMap(np.eye(3), quality=0.8)
    ViewMap(b_from_a: 3x3 0 to 1, quality=0.8)
    """

    b_from_a: np.ndarray | None
    quality: float


@dataclass(frozen=True)
class SharedFrame(Record):
    """One moment of several views.

    moment: number of the frame in the input, from 1. views: the input, with identities that all views share.
    own: (N,) of each view, the identities in the input. maps: the map of two views, by their numbers from 0.

    >>> one = td.Tracks(3, np.array([1]), np.array([[10.0, 20, 5, 9]]), np.ones(1), np.zeros(1, int))
    >>> frame = td.SharedFrame(3, (one, one), (np.array([7]), np.array([4])), {(0, 1): td.ViewMap(None, 0.0)})
    >>> frame.own, frame.shared
    ((array([7]), array([4])), (array([1]), array([1])))
    """

    moment: int
    views: tuple[Tracks | Positions, ...]
    own: tuple[np.ndarray, ...]
    maps: dict[tuple[int, int], ViewMap]

    @property
    def shared(self) -> tuple[np.ndarray, ...]:
        """The shared identities of each view, (N,)."""
        return tuple(identities_of(view) for view in self.views)


def identities_of(view: Tracks | Positions) -> np.ndarray:
    """Return the identities of tracks, or the targets of positions, (N,).

    >>> types.identities_of(td.Tracks(3, np.array([7]), np.ones((1, 4)), np.ones(1), np.zeros(1, int)))
    array([7])
    """
    return view.identity if isinstance(view, Tracks) else view.target
