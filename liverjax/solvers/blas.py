"""Threads of BLAS, the library of NumPy's and SciPy's dense matrices."""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager:
    """Limit BLAS to one thread inside a `with` block, for code with threads of its own or with small matrices.

    Its threads would wait for ours: a factorisation took three times as long, the step of a reduced model twice.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """The libraries that are loaded. SciPy loads its own with its dense matrices."""
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
