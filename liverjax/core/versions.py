"""Versions of the software that computed a result."""

import platform
from importlib.metadata import version


def versions() -> dict[str, str]:
    """Return the versions of Python, liverjax, jax, jaxlib, numpy and scipy."""
    import liverjax

    own = {"python": platform.python_version(), "liverjax": liverjax.__version__}
    return own | {p: version(p) for p in ("jax", "jaxlib", "numpy", "scipy")}
