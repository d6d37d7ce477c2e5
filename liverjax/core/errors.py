"""The exception for unusable input. Unusable input raises no other exception."""


class InputError(ValueError):
    """Raised for unusable input. The message gives file or field, value and remedy. Commands exit with code 2."""
