"""Releases of what computed a result."""

import platform
from importlib.metadata import version


def versions() -> dict[str, str]:
    """Python, liverjax, jax, jaxlib, numpy and scipy."""
    import liverjax

    own = {"python": platform.python_version(), "liverjax": liverjax.__version__}
    return own | {p: version(p) for p in ("jax", "jaxlib", "numpy", "scipy")}
