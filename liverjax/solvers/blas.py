"""Threads of BLAS, the library of NumPy's and SciPy's dense matrices."""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager:
    """Let BLAS have one thread within a `with`: where threads of our own run beside, or matrices are small.

    Its threads would wait for ours: a factorisation took three times as long, the step of a reduced model twice.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """The libraries that are loaded. SciPy loads its own with its dense matrices."""
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
