"""The operations that the detection chain is made of: their meaning, data type and rounding, stated once.

Two classes implement them: `OpenCVOperations` on arrays (onboard) and `functional.TensorOperations` on batches of
tensors (batch evaluation, gradients, ONNX export). Their results agree within one grey level, or one step of evidence.
"""

from typing import Any, Protocol, TypeVar

View = TypeVar("View", contravariant=True)
"""A frame as an engine holds it: a `detection.View`, or a (B, 1, H, W) float tensor of whole grey levels."""

Picture = TypeVar("Picture")
"""A map of whole numbers 0 to 255: (H, W) uint8 array, or (B, 1, H, W) uint8 tensor.

Masks that say where a picture counts (`exceeds`, `seen_by_both`) are 0 and 255 in arrays, and bool in tensors. The mask
of movers that `above` begins is 0 and 255, or with softness a float margin in steps of evidence: above 0 where the mask
is more than one half. `inside` and `outside` take pictures and evidence, not margins: evidence of 0 is a mask of 0.
"""

Seen = TypeVar("Seen")
"""Where a neighbour shows the reference's pixels."""

Number = Any
"""A float, or a tensor that takes gradients."""


class Operations(Protocol[View, Picture, Seen]):
    """What the chain asks of an engine's pictures. Pixels outside a picture mirror those inside, edge not repeated."""

    def grey(self, view: View) -> Picture:
        """The grey levels of a frame."""
        ...

    def texture(self, view: View) -> Picture:
        """Mean gradient magnitude over 5 x 5 px, rounded; 4 x grey levels a pixel, cut off at 255."""
        ...

    def no_texture(self, view: View) -> Picture:
        """A map of zeros that takes as little memory as possible."""
        ...

    def warp(self, view: View, reference: View, view_from_reference: Any) -> Picture:
        """The frame as the reference sees it: bilinear, places rounded to 1/32 px; the edge is repeated outside."""
        ...

    def seen(self, view: View, reference: View, view_from_reference: Any, border_px: int) -> Seen:
        """Where the frame shows the reference's pixels, but for a strip `border_px` wide inside its border."""
        ...

    def seen_by_both(self, one: Seen, other: Seen, reference: View) -> Picture:
        """The mask of the pixels that two frames show."""
        ...

    def fit_light(self, reference: View, warped: Picture, seen: Seen) -> tuple[Number, Number]:
        """Gain and offset that take the warped picture to the reference's exposure: trimmed least squares on a grid."""
        ...

    def fit_level_shares(self, reference: View, other: View) -> tuple[Number, Number]:
        """The same from the levels below which equal shares of two pictures lie; 1 and 0 where they hardly differ."""
        ...

    def apply_light(self, reference: View, warped: Picture, light: tuple[Number, Number]) -> Picture:
        """Gain x level + offset, rounded; where that is clipped at white it agrees with anything brighter."""
        ...

    def difference(self, one: Picture, other: Picture) -> Picture:
        """|one - other|."""
        ...

    def smaller(self, one: Picture, other: Picture) -> Picture:
        """The smaller one of each pixel."""
        ...

    def larger(self, one: Picture, other: Picture) -> Picture:
        """The larger one of each pixel."""
        ...

    def inside(self, picture: Picture, mask: Picture) -> Picture:
        """The picture where a mask is set, 0 elsewhere."""
        ...

    def outside(self, picture: Picture, mask: Picture) -> Picture:
        """The picture where a mask is not set, 0 elsewhere."""
        ...

    def exceeds(self, picture: Picture, level: float) -> Picture:
        """The mask of what is above a level."""
        ...

    def stands_out(self, picture: Picture, least: float, ratio: float) -> Picture:
        """The mask of what is above a level, and above a multiple of the picture's mean; both cut to whole levels."""
        ...

    def noise_weight(self, texture: Picture, noise_levels: Number, gradient_share: Number, scale: float) -> Any:
        """`scale` over the noise expected of a pixel, sqrt(noise_levels^2 + (gradient_share x gradient)^2)."""
        ...

    def weigh(self, picture: Picture, weight: Any, most: float) -> Picture:
        """Picture x weight, at most `most`, rounded."""
        ...

    def blur(self, picture: Picture, side: Number) -> Picture:
        """Gaussian of an odd side with OpenCV's weights; halves are rounded up."""
        ...

    def in_units_of_median(self, picture: Picture, mask: Picture, least: float) -> Picture:
        """The picture divided by its noise under the mask over `least`, rounded, where that is above 1.

        The noise is the median of regions, see `regional_medians`, which is never above that of the whole picture: what
        is restless, such as bare trees, must not hide what moves beside it.

        Unchanged where the mask has 500 pixels or fewer.
        """
        ...

    def above(self, evidence: Picture, limit: Number) -> Picture:
        """255 where evidence is above the limit; where masks are soft, by how much it is above."""
        ...

    def erode(self, mask: Picture, side: Number) -> Picture:
        """The smallest of an ellipse; outside the picture counts as set."""
        ...

    def dilate(self, mask: Picture, side: Number) -> Picture:
        """The largest of an ellipse; outside the picture counts as not set."""
        ...

    def close(self, mask: Picture, side: Number) -> Picture:
        """Dilate, then erode."""
        ...

    def halve(self, picture: Picture) -> Picture:
        """Means of 2 x 2 px, halves rounded up; an odd last row or column is left out."""
        ...
