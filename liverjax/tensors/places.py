"""Read array entries, or add to entries, at node or edge numbers. These numbers must be valid. They are not checked."""

import jax

from liverjax.core.struct import Indices


def taken(values: jax.Array, places: Indices) -> jax.Array:
    """Return the entries of `values` (n, …) at `places`, an array (of any shape) of whole numbers from 0 to n - 1."""
    return values.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def given(total: jax.Array, places: Indices, shares: jax.Array) -> jax.Array:
    """Add `shares` to `total` (n, …) at `places`, whole numbers from 0 to n - 1. A number may occur several times."""
    return total.at[places].add(shares, mode="promise_in_bounds", wrap_negative_indices=False)
