"""The operations of the detection chain: their meaning, data types and rounding.

Two classes implement them: `OpenCVOperations` on arrays (onboard) and `functional.TensorOperations` on batches of
tensors (batch evaluation, gradients, ONNX export). Their results agree within one grey level, or one step of evidence.
"""

from typing import Any, Protocol, TypeVar

View = TypeVar("View", contravariant=True)
"""A frame in the form of an engine: a `detection.View`, or a (B, 1, H, W) float tensor of whole grey levels."""

Picture = TypeVar("Picture")
"""A map of whole numbers 0 to 255: (H, W) uint8 array, or (B, 1, H, W) uint8 tensor.

Masks of valid pixels (`exceeds`, `seen_by_both`) are 0 and 255 in arrays, and bool in tensors. The mask of moving
pixels that `above` returns is 0 and 255. With softness it is a float margin in steps of evidence instead, above 0 where
the hard mask is set. `inside` and `outside` take pictures and evidence, but not margins.
"""

Seen = TypeVar("Seen")
"""The area of the reference's pixels that a neighbour shows."""

Number = Any
"""A float, or a tensor with gradients."""


class Operations(Protocol[View, Picture, Seen]):
    """The operations that an engine provides. Pictures are mirrored at their border; the edge is not repeated."""

    def grey(self, view: View) -> Picture:
        """Return the grey levels of a frame."""
        ...

    def texture(self, view: View) -> Picture:
        """Return the mean gradient magnitude over 5 x 5 px, in 4 x grey levels a pixel, rounded, at most 255."""
        ...

    def no_texture(self, view: View) -> Picture:
        """Return a map of zeros that takes as little memory as possible."""
        ...

    def warp(self, view: View, reference: View, view_from_reference: Any) -> Picture:
        """Warp a frame to the reference: bilinear, positions rounded to 1/32 px, the edge repeated outside."""
        ...

    def seen(self, view: View, reference: View, view_from_reference: Any, border_px: int) -> Seen:
        """Find the reference's pixels that the frame shows, without a strip of `border_px` inside its border."""
        ...

    def seen_by_both(self, one: Seen, other: Seen, reference: View) -> Picture:
        """Return the mask of the pixels that two frames show."""
        ...

    def fit_light(self, reference: View, warped: Picture, seen: Seen) -> tuple[Number, Number]:
        """Fit gain and offset from the warped picture to the reference by trimmed least squares on a grid."""
        ...

    def fit_level_shares(self, reference: View, neighbour: View) -> tuple[Number, Number]:
        """Fit gain and offset to quantiles of the grey levels of two frames; 1 and 0 if they are nearly equal."""
        ...

    def apply_light(self, reference: View, warped: Picture, light: tuple[Number, Number]) -> Picture:
        """Return gain x level + offset, rounded. A pixel clipped at white takes the reference's value if brighter."""
        ...

    def difference(self, one: Picture, other: Picture) -> Picture:
        """Return the absolute difference of two pictures."""
        ...

    def smaller(self, one: Picture, other: Picture) -> Picture:
        """Return the smaller value at each pixel."""
        ...

    def larger(self, one: Picture, other: Picture) -> Picture:
        """Return the larger value at each pixel."""
        ...

    def inside(self, picture: Picture, mask: Picture) -> Picture:
        """Return the picture where a mask is set, and 0 elsewhere."""
        ...

    def outside(self, picture: Picture, mask: Picture) -> Picture:
        """Return the picture where a mask is not set, and 0 elsewhere."""
        ...

    def exceeds(self, picture: Picture, level: float) -> Picture:
        """Return the mask of the pixels above a level."""
        ...

    def stands_out(self, picture: Picture, least: float, ratio: float) -> Picture:
        """Return the mask of the pixels above `least` and above `ratio` x the picture's mean, both rounded down."""
        ...

    def noise_weight(self, texture: Picture, noise_levels: Number, gradient_share: Number, scale: float) -> Any:
        """Return `scale` / noise, where noise = sqrt(noise_levels^2 + (gradient_share x gradient)^2)."""
        ...

    def weigh(self, picture: Picture, weight: Any, most: float) -> Picture:
        """Return picture x weight, at most `most`, rounded."""
        ...

    def blur(self, picture: Picture, side: Number) -> Picture:
        """Smooth by a Gaussian of an odd side with OpenCV's weights; halves are rounded up."""
        ...

    def in_units_of_median(self, picture: Picture, mask: Picture, least: float) -> Picture:
        """Divide the picture by its noise / `least` where that ratio is above 1, and round.

        The noise is the median in regions under the mask, see `regional_medians`. It is never above the median of the
        whole picture, so that restless areas, such as bare trees, do not hide targets beside them.

        The picture is unchanged if the mask has 500 pixels or fewer.
        """
        ...

    def above(self, evidence: Picture, limit: Number) -> Picture:
        """Return 255 where evidence is above the limit; for soft masks, evidence minus the limit."""
        ...

    def erode(self, mask: Picture, side: Number) -> Picture:
        """Return the minimum over an ellipse. Pixels outside the picture count as set."""
        ...

    def dilate(self, mask: Picture, side: Number) -> Picture:
        """Return the maximum over an ellipse. Pixels outside the picture count as not set."""
        ...

    def close(self, mask: Picture, side: Number) -> Picture:
        """Dilate, then erode."""
        ...

    def halve(self, picture: Picture) -> Picture:
        """Return the means of 2 x 2 px, halves rounded up, without an odd last row or column."""
        ...
