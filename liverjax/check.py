"""The gradient check of laws under its short name for users: everything of `liverjax.laws.gradient_check`."""

from liverjax.laws.gradient_check import *  # noqa: F403
