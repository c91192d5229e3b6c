"""Results kept by what they depend on: each appears whole or not at all, and is computed again where it is damaged."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.stored import DamagedError, packed, unpacked, whole
from torchvision_dddas.io.atomic_files import cannot_write, remove, write_whole

Tell = Callable[[str], object]


class Store(Protocol):
    """Where results are kept."""

    def get(self, key: str) -> Any | None:
        """The record of a key; None where there is none."""
        ...

    def put(self, key: str, record: Any) -> None:
        """Keep a record."""
        ...


class Cache:
    """A folder of records, one file each, named by their keys. Several processes may use it at once."""

    def __init__(self, folder: Path, tell: Tell = lambda line: None) -> None:
        """tell: is given a line for each entry that is damaged. Raises InputError where no folder can be made."""
        self.folder, self._tell = folder, tell
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"no folder can be at {folder}: {error.strerror}; choose another --cache") from None

    def place(self, key: str) -> Path:
        """The file of a key."""
        return self.folder / key[:2] / f"{key}.npz"

    def has(self, key: str) -> bool:
        """Whether there is an entry that is whole; one that is damaged is told of and removed."""
        content = self.content(key)
        return content is not None and (whole(content) or self._damaged(key))

    def get(self, key: str) -> Any | None:
        """The record of a key; None where there is none. One that is damaged is told of and removed."""
        content = self.content(key)
        try:
            return None if content is None else unpacked(content)
        except DamagedError:
            self._damaged(key)
            return None

    def _damaged(self, key: str) -> bool:
        self._tell(f"{self.place(key)} is damaged: it is computed again")
        remove(self.place(key))
        return False

    def content(self, key: str) -> bytes | None:
        """The bytes of an entry, unchecked; None where there is none."""
        try:
            return self.place(key).read_bytes()
        except OSError:
            return None

    def put(self, key: str, record: Any) -> None:
        """Keep a record. Raises InputError where the disk refuses."""
        self.keep(key, packed(record))

    def keep(self, key: str, content: bytes) -> None:
        """The same for a record that is bytes already."""
        place = self.place(key)
        try:
            place.parent.mkdir(exist_ok=True)
            write_whole(place, content)
        except OSError as error:
            said = str(cannot_write(place, error)).replace("another --out", "another --cache")
            raise InputError(said) from None


class Carried:
    """Records that travel with a job, as bytes: those known before it, and those that it makes."""

    def __init__(self, known: dict[str, bytes]) -> None:
        self._known = known
        self.made: dict[str, bytes] = {}

    def get(self, key: str) -> Any | None:
        """The record of a key; None where there is none, or one that is damaged."""
        content = self.made.get(key) or self._known.get(key)
        try:
            return None if content is None else unpacked(content)
        except DamagedError:
            return None

    def put(self, key: str, record: Any) -> None:
        """Keep a record."""
        self.made[key] = packed(record)
