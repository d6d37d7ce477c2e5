"""Proper orthogonal decomposition: find a few fields that represent many fields up to a small error."""

import numpy as np

#: Maximum size of the matrix of scalar products. If there are more rows and more columns than this, only this number of
#: evenly spaced rows is used.
MOST_PRODUCTS = 6000


def principal_fields(rows: np.ndarray, tolerance: float) -> np.ndarray:
    """Return orthonormal fields (n, P) that represent rows (N, P) with a relative error of at most `tolerance`.

    The error is relative to the Frobenius norm of the N rows, which have P values each. The n fields are computed from
    the eigenvectors of the matrix of scalar products between rows, or between columns if there are fewer columns
    (Sirovich 1987). In scalar products, half of the significant digits are lost, so the minimum useful tolerance is
    1e-7.
    """
    if min(rows.shape) > MOST_PRODUCTS:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_PRODUCTS).round().astype(int)]
    few_rows = len(rows) <= rows.shape[1]
    size, vectors = np.linalg.eigh(rows @ rows.T if few_rows else rows.T @ rows)
    size, vectors = np.maximum(size[::-1], 0.0), vectors[:, ::-1]
    left = np.sqrt(np.maximum(size.sum() - np.cumsum(size), 0.0) / size.sum())
    n = min(int(np.sum(left > tolerance)) + 1, int(np.sum(size > 1e-14 * size[0])))
    fields = vectors[:, :n].T @ rows if few_rows else vectors[:, :n].T
    # After this factorisation, the fields are orthonormal to full precision.
    return np.linalg.qr(fields.T)[0].T
