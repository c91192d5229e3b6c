"""TOML files, opened in one way."""

import tomllib
from pathlib import Path
from typing import Any

from torchvision_dddas.errors import InputError


def toml_of(path: str | Path, what: str) -> dict[str, Any]:
    """What a file holds; what: what it is, for messages. Raises InputError where it cannot be read, or is no TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{what} {path} is no TOML: its brackets go too deep") from None
    except ValueError as error:  # no UTF-8, no TOML, or a number of thousands of digits
        raise InputError(f"{what} {path} is no TOML: {str(error).split(';')[0]}") from None
