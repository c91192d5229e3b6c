"""Parameters of the default tracker and of the source's association."""

from typing import Literal

from torchvision_dddas.config.group import Group, parameter


class TrackParameters(Group):
    """Start, links and end of tracks. Lengths are in box heights."""

    mode: Literal["default", "paper"] = parameter(
        "default", "default: links scored by motion, size and appearance; paper: the source's affinity"
    )
    look_ahead: bool = parameter(True, "decide with the next frame in view (K = 3); false decides at once")
    appearance: Literal["always", "ambiguous", "never"] = parameter(
        "ambiguous", "compare appearance: always, only where locations are ambiguous, or never"
    )
    doubt: float = parameter(
        8.0,
        "a detection is tracked if its doubt, 1 / score - 1, is at most this many times the usual doubt",
        "-",
        0,
        1000,
    )
    birth_doubt: float = parameter(
        3.0, "a detection may start a track if its doubt is at most this many times the usual doubt", "-", 0, 1000
    )
    hits: int = parameter(3, "detections that confirm a track; a single one of score 1 is enough", "frames", 1, 60)
    smooth: bool = parameter(True, "move boxes with a score below 1 to the smoothed track")
    memory_frames: int = parameter(125, "how long an unseen track is kept", "frames", 1, 10_000)
    memory_outside_frames: int = parameter(10, "how long a track that left the picture is kept", "frames", 1, 10_000)
    wander: float = parameter(0.3, "change of velocity between looks, as a share of the usual step", "-", 1e-3, 10)
    scatter: float = parameter(0.06, "standard deviation of a detection's centre", "heights", 1e-3, 1)
    size_scatter: float = parameter(0.1, "standard deviation of the logarithm of a detection's height", "-", 1e-3, 10)
    tail: float = parameter(
        4.0, "degrees of freedom of the distance's t distribution; low: tolerate sharp turns and stops", "-", 0.1, 100
    )
    upright: float = parameter(0.6, "vertical motion of upright targets divided by sideways motion", "-", 0.1, 2)
    crossing: float = parameter(
        0.2, "share of the targets at the picture's border that enter or leave in a look", "-", 0, 1
    )
    hiding: float = parameter(
        0.75, "probability that an undetected target stays undetected at the next look", "-", 0.01, 1
    )
    rest_drift: float = parameter(0.03, "drift per look of an unseen target that may stand still", "heights", 1e-4, 1)
    rest_price: float = parameter(1.0, "cost of assuming that a lost target stood still", "-", 0, 20)
    own_scatter: float = parameter(0.2, "`scatter` for moving targets that dddas detected", "heights", 1e-3, 1)
    own_size_scatter: float = parameter(
        1.0, "`size_scatter` for moving targets that dddas detected, which split and merge", "-", 1e-3, 10
    )
    appearance_weight: float = parameter(10.0, "weight of the similarity of appearance", "-", 0, 100)
    appearance_offset: float = parameter(0.86, "similarity of appearance that is neutral for a link", "-", 0, 1)


class PaperParameters(Group):
    """The source's association (appendix C, III). Ambiguities of its text are options; the defaults link targets."""

    window: int = parameter(3, "number of frames associated at once: K of the source", "frames", 2, 3)
    rule: Literal["dispersion", "fixed"] = parameter(
        "dispersion", "weight of location: dispersion computes it (III-D), fixed takes `weight`"
    )
    weight: float = parameter(0.7, "share of location in the affinity if the rule is fixed", "-", 0, 1)
    lowest_dispersion: float = parameter(
        0.65, "a feature of larger dispersion distinguishes targets: LL of III-D", "-", 0, 1
    )
    location_cut: float = parameter(
        0.25, "dissimilarity at which the cluster tree of locations is cut: G for 2 dimensions (III-E)", "-", 0, 1
    )
    appearance_cut: float = parameter(
        0.296, "dissimilarity at which the cluster tree of histograms is cut: G for 3 dimensions (III-E)", "-", 0, 1
    )
    dispersion_of: Literal["smallest", "smallest_if_counts_differ", "newest"] = parameter(
        "smallest_if_counts_differ", "which frame of the window gives the dispersion"
    )
    gate: Literal["one_dummy", "every_dummy", "off"] = parameter(
        "one_dummy", "entries to raise to 1 - threshold: with one dummy, with any number (as printed), or none"
    )
    gated: Literal["features", "affinity"] = parameter(
        "features", "gate location and appearance, or their weighted sum"
    )
    threshold: float = parameter(0.4, "dummy entries are raised if all real entries are below 1 - threshold", "-", 0, 1)
    dummy: Literal["zero", "formula", "real_pair"] = parameter(
        "formula",
        "affinity with a dummy before the gate. formula: eq. 4 and 5 with a zero vector; zero: as the text says; "
        "real_pair (ours): as formula, but the gate raises it only for pairs with a similarity from 1 - threshold",
    )
    histogram: Literal["channel", "count"] = parameter(
        "channel", "channel: histograms sum to 1 per channel; count: they hold counts, so size matters too"
    )
    histogram_scale: float = parameter(
        0.4, "factor on the dissimilarity of histograms; 1: as printed, where the gate cuts true links", "-", 0.1, 1
    )
    exact_targets: int = parameter(12, "largest number of targets a frame for the exact solution", "targets", 0, 1000)
    gap: float = parameter(0.005, "relaxation aims at a solution within this share of the bound", "-", 0, 1)
