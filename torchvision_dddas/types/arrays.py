"""Annotations of arrays with their shapes."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
else:
    # jaxtyping takes 0.1 s and 10 MB to import, so at run time its annotations are replaced by the plain array type.
    class _Array:
        def __class_getitem__(cls, array_and_shape: tuple[type, str]) -> type:
            return array_and_shape[0]

    Bool = Float = Int = _Array
