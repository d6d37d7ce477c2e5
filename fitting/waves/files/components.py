"""Check from the data alone whether the components of the displacement are in the directions of the voxel axes.

Shear waves do not change the volume, so the divergence of the displacement is small. The divergence is large if two
components are exchanged, or if a component has the wrong sign. Such errors occur when data are moved between programs,
if one program stores arrays by rows and the other by columns.
"""

import itertools

import numpy as np

from fitting.waves.wave_field import WaveField

#: Minimum number of voxels with all six neighbours; with fewer, the order of the components is not checked.
FEWEST = 100
#: Another order or sign of the components is regarded as better if the mean square divergence is below this fraction of
#: its value for the given order.
SMALLER = 0.8


def other_order(field: WaveField) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """Return for each axis the component and the sign with which the divergence is smallest. Return None if the given
    order is nearly as good, or if there are too few voxels."""
    slopes = _central_differences(field)
    if slopes.shape[2] < FEWEST:
        return None
    # The mean products of all derivatives d_a u_c give the mean square divergence for every order and sign.
    flat = slopes.reshape(9, -1)
    products = (flat @ flat.conj().T).real.reshape(3, 3, 3, 3)
    best: tuple[tuple[int, ...], tuple[int, ...]] = ((0, 1, 2), (1, 1, 1))
    least = given = float(np.einsum("aabb", products))
    for order in itertools.permutations(range(3)):
        for signs in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)):
            pairs = itertools.product(range(3), repeat=2)
            found = sum(signs[a] * signs[b] * products[a, order[a], b, order[b]] for a, b in pairs)
            if found < least:
                best, least = (order, signs), float(found)
    return best if least < SMALLER * given else None


def order_sentence(field: WaveField) -> str | None:
    """Return a warning if another order or sign of the components would fit the axes much better; otherwise None."""
    found = other_order(field)
    if found is None:
        return None
    order, signs = found
    whole = -1 if sum(signs) < 0 else 1  # a common sign of all components does not matter
    names = ", ".join(("-" if whole * s < 0 else "") + "xyz"[c] for c, s in zip(order, signs, strict=True))
    empty = [axis for c, axis in enumerate("xyz") if not np.any(np.nan_to_num(field.displacement[..., c]))]
    instead = f". The cause may be a component that was not measured ({', '.join(empty)}): write NaN instead of zeros"
    return (
        f"the components of the displacement may have a wrong order or sign: with order and signs ({names}), the "
        "displacements change the volume much less, as expected for shear waves. Give the components in the order and "
        f"with the signs of the voxel axes{instead if empty else ''}"
    )


def _central_differences(field: WaveField) -> np.ndarray:
    """Return central differences d_a u_c (3, 3, n) at voxels with six measured neighbours in the mask. The differences
    are scaled to a root mean square of 1 at each frequency."""
    U, rows = np.where(field.mask[..., None], field.displacement, np.nan), []
    middle = tuple(slice(1, -1) for _ in range(3))
    for u in U:
        each = []
        for axis in range(3):
            ahead, behind = list(middle), list(middle)
            ahead[axis], behind[axis] = slice(2, None), slice(None, -2)
            each.append((u[tuple(ahead)] - u[tuple(behind)]) / (2 * field.spacing[axis]))
        slopes = np.stack(each).reshape(3, -1, 3).transpose(0, 2, 1)
        inside = np.isfinite(slopes).all(axis=(0, 1)) & field.mask[middle].ravel()
        slopes = slopes[:, :, inside]
        size = np.sqrt(np.mean(np.abs(slopes) ** 2)) if slopes.size else 0.0
        rows.append(slopes / size if size > 0 else slopes[:, :, :0])
    return np.concatenate(rows, axis=2)
