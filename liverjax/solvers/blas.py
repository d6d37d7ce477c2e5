"""Threads of BLAS, the library that NumPy and SciPy use for dense matrices."""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_blas_thread() -> AbstractContextManager:
    """Limit BLAS to one thread inside a `with` block, for code with several threads or with small matrices.

    With more BLAS threads, the threads of BLAS and of this program would wait for each other. In tests with more BLAS
    threads, a factorisation took three times as long, and a step of a reduced model twice as long.
    """
    return _libraries().limit(limits=1, user_api="blas")


@cache
def _libraries() -> ThreadpoolController:
    """Return the loaded BLAS libraries. `scipy.linalg` is imported because it loads a separate BLAS library."""
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
