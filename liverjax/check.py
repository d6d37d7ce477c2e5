"""Short name for the gradient check of material laws, `liverjax.laws.gradient_check`."""

from liverjax.laws.gradient_check import *  # noqa: F403
