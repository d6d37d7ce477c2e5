"""The exception that is raised for unusable input of a user. No other exception is raised for such input."""


class InputError(ValueError):
    """Raised for unusable input. The message gives the file or field, its value and a remedy.

    A command that raises this error exits with code 2.
    """
