"""Subsets of elements that are computed separately.

Functions of this module select the values of one subset, and join the values of all subsets.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from liverjax.core.struct import Number

T = TypeVar("T")


class Subsets(NamedTuple):
    """A partition of the elements: every element is in exactly one subset."""

    #: Element numbers (1, n) of each subset. The first axis distinguishes these arrays from arrays (n,) of element
    #: values.
    elements: tuple[jax.Array, ...]
    places: jax.Array  # (E,), or (1, E) with several integration points: position of each element in the joined subsets

    @property
    def number_of_elements(self) -> int:
        """Return the number E of all elements."""
        return self.places.shape[-1]


def subsets(groups: Sequence[Any], number_of_elements: int) -> Subsets:
    """Return the subsets: first the elements without a group (if there are any), then the groups.

    Args:
        groups: element numbers (n,) of each group. No element is in two groups. Inside jit the numbers may be unknown.
        number_of_elements: number E of all elements.
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
    """Return a pytree in which arrays (…, E) and (…, E, 3) have values only for the elements of subset k.

    E is the number of all elements. Other arrays do not change.
    """
    E, own = s.number_of_elements, s.elements[k][0]

    def one(a: Number) -> Number:
        shape = jnp.shape(a)
        if shape[-2:] == (E, 3):  # tested first: in a body of three elements, arrays of directions are (3, 3)
            return jnp.asarray(a)[..., own, :]
        return jnp.asarray(a)[..., own] if shape[-1:] == (E,) else a

    return jax.tree.map(one, numbers)


def put_together(s: Subsets, numbers: Sequence[T]) -> T:
    """Join the pytrees of all subsets into one pytree with the values of all elements.

    The pytrees have the same structure, and contain arrays (…, n) for the n elements of their subset.
    """
    leaves, trees = zip(*(jax.tree.flatten(each) for each in numbers), strict=True)
    shapes = [
        jnp.broadcast_shapes(*map(jnp.shape, own), (e.shape[1],)) for own, e in zip(leaves, s.elements, strict=True)
    ]
    lead = jnp.broadcast_shapes(s.places.shape[:-1], *(shape[:-1] for shape in shapes))
    dtype = jnp.result_type(*(a for own in leaves for a in own))
    # The values of each subset are stacked in one array, so that a single copy arranges the values of all elements.
    stacked = [
        jnp.stack([jnp.broadcast_to(jnp.asarray(a, dtype), (*lead, shape[-1])) for a in own])
        for own, shape in zip(leaves, shapes, strict=True)
    ]
    whole = jnp.concatenate(stacked, axis=-1)[..., s.places.reshape(-1)]
    return jax.tree.unflatten(trees[0], list(whole))
