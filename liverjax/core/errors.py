"""The exception for unusable input: unusable input causes no other."""


class InputError(ValueError):
    """Unusable input. The message is one sentence with file or field, value and remedy. Commands exit with code 2."""
