"""Arrays' shapes for the reader and the type checker: jaxtyping's names, which a run neither needs nor waits for.

jaxtyping takes 0.1 s and 10 MB to import. Here its annotations stand for the array alone; `ops`, which is checked
against its shapes in tests, takes them from jaxtyping itself.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
else:

    class _Array:
        def __class_getitem__(cls, array_and_shape: tuple[type, str]) -> type:
            return array_and_shape[0]

    Bool = Float = Int = _Array

__all__ = ["Bool", "Float", "Int"]
