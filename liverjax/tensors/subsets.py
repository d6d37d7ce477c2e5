"""Subsets of elements that are computed separately: select the values of a subset, and join those of all subsets."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number

T = TypeVar("T")


class Subsets(NamedTuple):
    """A partition of the elements: every element is in exactly one subset."""

    elements: tuple[jax.Array, ...]  # element numbers (1, n) of each subset; no array of element values has this shape
    places: jax.Array  # position of each element in the joined subsets: (E,), or (1, E) with several points

    @property
    def number_of_elements(self) -> int:
        """Number of elements, E."""
        return self.places.shape[-1]


def subsets(groups: Sequence[Any], number_of_elements: int) -> Subsets:
    """Return the subsets: first the elements without a group, if any, then each group.

    Args:
        groups: element numbers (n,) of groups without common elements. Inside jit these numbers may be unknown.
        number_of_elements: E.
    """
    E = number_of_elements
    groups = [jnp.asarray(group, jnp.int32) for group in groups]
    rest = E - sum(len(group) for group in groups)
    if rest:
        others = jnp.ones(E, bool).at[jnp.concatenate(groups)].set(False)
        groups = [jnp.nonzero(others, size=rest)[0].astype(jnp.int32), *groups]
    places = jnp.zeros(E, jnp.int32).at[jnp.concatenate(groups)].set(jnp.arange(E, dtype=jnp.int32))
    return Subsets(tuple(group[None] for group in groups), places)


def in_subset(s: Subsets, k: int, numbers: T) -> T:
    """Reduce the arrays (…, E) and (…, E, 3) of a pytree to the elements of subset k. Other arrays are not changed."""
    E, own = s.number_of_elements, s.elements[k][0]

    def one(a: Number) -> Number:
        shape = jnp.shape(a)
        if shape[-1:] == (E,):
            return jnp.asarray(a)[..., own]
        return jnp.asarray(a)[..., own, :] if shape[-2:] == (E, 3) else a

    return jax.tree.map(one, numbers)


def put_together(s: Subsets, numbers: Sequence[T]) -> T:
    """Join the pytrees of all subsets (of the same structure, with arrays (…, n)) to values of all elements."""
    leaves, trees = zip(*(jax.tree.flatten(each) for each in numbers), strict=True)
    shapes = [
        jnp.broadcast_shapes(*map(jnp.shape, own), (e.shape[1],)) for own, e in zip(leaves, s.elements, strict=True)
    ]
    lead = jnp.broadcast_shapes(s.places.shape[:-1], *(shape[:-1] for shape in shapes))
    dtype = jnp.result_type(*(a for own in leaves for a in own))
    # One array per subset, so that one copy brings the numbers of all elements into order.
    stacked = [
        jnp.stack([jnp.broadcast_to(jnp.asarray(a, dtype), (*lead, shape[-1])) for a in own])
        for own, shape in zip(leaves, shapes, strict=True)
    ]
    whole = jnp.concatenate(stacked, axis=-1)[..., s.places.reshape(-1)]
    return jax.tree.unflatten(trees[0], list(whole))
