"""The one exception a user meets: a sentence that names field, value and remedy."""


class InputError(ValueError):
    """Unusable input. The message is one sentence naming file or field, value and remedy; command lines exit with 2."""
