"""The options of a kind, checked: what a study's file says beside kind, folder and clips."""

from collections.abc import Mapping
from typing import Any

from torchvision_dddas.errors import InputError

_WORDS = {str: "a text", bool: "true or false", int: "a whole number", float: "a number", list: "a list of texts"}


def checked(kind: str, options: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The options in force. wanted: name -> the value where it is not given, whose type is the option's.

    A list holds texts; None stands for a number above 0 that need not be given. Raises InputError: an unknown name,
    another type.
    """
    for name, value in options.items():
        if name not in wanted:
            takes = f"it takes {', '.join(wanted)}" if wanted else "it takes none"
            raise InputError(f"a data set of kind {kind} has no option '{name}'; {takes}")
        default = wanted[name]
        type_ = float if default is None else type(default)
        fits = isinstance(value, (int, float) if type_ is float else type_) and (
            type_ is bool or not isinstance(value, bool)
        )
        if type_ is list:
            fits = fits and all(isinstance(text, str) for text in value)
        if default is None:
            fits = fits and 0 < value <= 1000
        if not fits:
            what = "a number above 0, at most 1000" if default is None else _WORDS[type_]
            raise InputError(f"{name} = {value!r} will not do for a data set of kind {kind}; wanted {what}")
    return {**wanted, **options}
