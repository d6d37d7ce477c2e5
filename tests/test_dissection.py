"""Division of a mesh: the parts are separated by as few nodes as possible."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.csgraph import connected_components

import liverjax as lj
from liverjax.mesh.files import read_mesh
from liverjax.solvers.factors import dissection, multifrontal

pytestmark = pytest.mark.quick_to_compile

DATA = Path(__file__).parents[1] / "data"


def mesh(cells: tuple[int, int, int], shaken: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    box = lj.shapes.box(tuple(float(n) for n in cells), cells)
    points = np.asarray(box.points)
    return np.asarray(box.tetrahedra).T, points + shaken * np.random.default_rng(1).normal(size=points.shape)


def test_layers_are_parted_between_them():
    """Fifteen layers have a middle layer. A cut through it has more nodes than the 36 of the plane beside it."""
    elements, points = mesh((5, 5, 15))
    assert len(dissection.dissected(elements, points)[-1][0]) == 36


@pytest.mark.parametrize("shaken", [0.0, 0.3])
def test_no_element_has_nodes_of_two_parts(shaken):
    """Without the last group of nodes the body is disconnected. Each node is in one group."""
    elements, points = mesh((5, 6, 9), shaken)
    groups = dissection.dissected(elements, points)
    assert sorted(np.concatenate([nodes for nodes, _ in groups])) == list(range(len(points)))
    of_group = {}
    for k, (_, children) in enumerate(groups):
        of_group[k] = set().union({k}, *(of_group[c] for c in children))
    for k, (_, children) in enumerate(groups):
        below = [np.isin(elements, np.concatenate([groups[g][0] for g in of_group[c]])).any(axis=0) for c in children]
        assert not any(np.any(a & b) for a, b in itertools.combinations(below, 2)), k
    pairs = tuple(a.ravel() for a in np.broadcast_arrays(elements[:, None], elements[None]))
    inside = np.setdiff1d(np.arange(len(points)), groups[-1][0])
    near = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs)).tocsr()[inside][:, inside]
    sizes = np.bincount(connected_components(near)[1])
    assert len(sizes) > 1 and sizes.max() < 0.8 * len(points)


@pytest.mark.parametrize("seed", range(4))
def test_no_other_cut_has_fewer_nodes(seed):
    """Compare with all ways to divide ten elements between two sides, where some nodes are assigned already."""
    rng = np.random.default_rng(seed)
    elements, points = mesh((2, 2, 3), 0.2)
    elements = elements[:, np.argsort(points[elements].mean(axis=0)[:, 2])]
    nodes = np.sort(rng.permutation(len(points))[: len(points) - 4])
    low, high = 25, 35
    span = (np.empty(len(points), int), np.empty(len(points), int))
    dissection._first_and_last(elements, span)
    among = elements[:, low:high]

    def between(first_side: np.ndarray) -> int:
        sides = [
            np.concatenate([elements[:, :low].ravel(), among[:, first_side].ravel()]),
            np.concatenate([elements[:, high:].ravel(), among[:, ~first_side].ravel()]),
        ]
        return len(np.intersect1d(np.intersect1d(*sides), nodes))

    every = [between(np.array(own)) for own in itertools.product([False, True], repeat=high - low)]
    found = dissection._smallest_cuts(among, nodes, span, (low, high))
    assert [between(own) for own in found] == [min(every)] * 2
    assert min(every) < between(np.arange(high - low) < (high - low) // 2)


def test_smallest_cuts_save_a_quarter_where_there_are_no_layers(monkeypatch):
    """The saving is a quarter of the work to eliminate the liver phantom."""
    body = lj.quadratic(read_mesh(DATA / "liver_phantom.vtu"))
    elements, points = np.stack(body.element_nodes), np.asarray(body.points)
    pairs = tuple(a.ravel() for a in np.broadcast_arrays(elements[:, None], elements[None]))
    near = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs)).tocsr()

    def work() -> float:
        groups = dissection.dissected(elements, points)
        plan = multifrontal.fronts(near, groups, np.arange(len(points)))
        return sum(float(dissection.work(len(front.own), len(front.border))) for front in plan)

    found = work()
    monkeypatch.setattr(dissection, "BETTER", 0.0)
    assert found < 0.75 * work()
