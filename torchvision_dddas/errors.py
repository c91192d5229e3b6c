"""The one error that a user's mistake raises, and the checks that raise it."""

LONGEST = 1000
"""Characters of a message; what came may have been of any length."""

_END = 300  # of these, those that are kept of its end, which says what to do


class InputError(ValueError):
    """Bad input in one clear line: what came, what was wanted, what to do. The command line exits with 2 on it.

    What came may hold line feeds, what steers a terminal, or half a character: such is shown by its number. The middle
    of an endless line is left out.
    """

    def __init__(self, text: object = "") -> None:
        super().__init__(_line(str(text)))


def _line(text: str) -> str:
    if not text.isprintable():
        text = "".join(map(_shown, " ".join(text.splitlines()).replace("\t", " ")))
    return text if len(text) <= LONGEST else f"{text[: LONGEST - _END - 5]} ... {text[-_END:]}"


def _shown(letter: str) -> str:
    return letter if letter.isprintable() else letter.encode("unicode_escape", "surrogatepass").decode("ascii")
