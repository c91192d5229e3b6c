"""The one error that a user's mistake raises, and the checks that raise it."""


class InputError(ValueError):
    """Bad input in one clear line: what came, what was wanted, what to do. The command line exits with 2 on it."""
