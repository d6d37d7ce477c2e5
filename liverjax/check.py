"""The gradient check of laws under the name that users have: all of `liverjax.laws.gradient_check`."""

from liverjax.laws.gradient_check import *  # noqa: F403
