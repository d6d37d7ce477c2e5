"""Trajectories and equilibria of other programs, compared at each node. Their files are not part of the project."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHARED

import liverjax as lj
from liverjax.core.struct import replace


def _file(*parts: str):
    file = SHARED.joinpath("reference", *parts)
    if not file.exists():
        pytest.skip(f"{'/'.join(parts)} of another program is not here")
    return file


@pytest.mark.slow
def test_a_hundred_steps_of_sofa(verified):
    """SOFA 26.12: implicit Euler, one linear solve per step, the same mass at every node."""
    points, tets = (np.loadtxt(_file("febio", name), delimiter=",") for name in ("cube3_nodes.csv", "cube3_tets.csv"))
    rows = np.loadtxt(_file("sofa", "dyn3_NeoHookean_n100_out.csv"), delimiter=",")
    assert np.allclose(rows[:, :3], points[:, -3:], atol=1e-12)
    mesh = lj.tet_mesh(rows[:, :3], tets[:, -4:].astype(int))
    held = np.flatnonzero(np.all(rows[:, :3] == rows[:, 3:6], axis=1))
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookeanCompressible(mu=770.0, lame_lambda=3080.0),
        fixed=(lj.Fixed(nodes=jnp.asarray(held)),),
        body=lj.Body(
            density=jnp.asarray(100 / 64 / np.asarray(lj.boundary.nodal_volumes(mesh))),
            gravity=jnp.array([2.0, 0, -2.0]),
        ),
        solve=lj.Solve(kind="dynamic", dt=0.01, steps=100, newton="one_step", linear_solver="direct"),
    )
    x = np.asarray(lj.simulate(scene).positions[-1])
    moved, difference = np.abs(rows[:, 3:6] - rows[:, :3]).max(), np.abs(x - rows[:, 3:6]).max()
    # A hundred steps, each exact to rounding of the positions. The error grows at most with the number of steps.
    assert moved > 0.3 and difference < 100 * 2.2e-16 * 2
    verified("cube thrown by its weight, 100 steps", "SOFA", difference / moved, 1e-13)


def authors_cantilever() -> tuple[lj.Scene, np.ndarray]:
    """The silicone cantilever of Mazier et al. 2021 on its authors' mesh, and the final positions of their program."""
    mesh = lj.read_mesh(_file("mjed_authors", "cylinder_7675.vtk"))
    held = np.flatnonzero(np.abs(np.asarray(mesh.points)[:, 2]) < 1e-9)
    scene = lj.Scene(
        mesh=mesh,
        law=lj.laws.MooneyRivlin(c10=151065.46, c01=101709.668, bulk=1e7, volumetric="log"),
        body=lj.Body(density=963.0, gravity=jnp.array([0.0, -9.81, 0.0])),
        fixed=(lj.Fixed(nodes=jnp.asarray(held)),),
        solve=lj.Solve(steps=10),
    )
    return scene, np.asarray(lj.read_mesh(_file("mjed_authors", "cylinder_7675_deformed.vtk")).points)


@pytest.mark.slow
def test_the_cantilever_of_the_authors_node_by_node(verified):
    scene, theirs = authors_cantilever()
    result = lj.simulate(scene).check()
    moved = np.linalg.norm(theirs - np.asarray(scene.mesh.points), axis=1).max()
    difference = np.linalg.norm(np.asarray(result.positions[-1]) - theirs, axis=1).max()
    # Their file has six digits of positions up to 0.18 m: 5e-7 m along each axis.
    assert moved > 0.1 and difference < np.sqrt(3) * 5e-7
    verified("silicone cantilever, 7,675 linear elements", "MJED of the authors, in SOFA", difference / moved, 1e-5)


@pytest.mark.slow
def test_quadratic_elements_on_the_authors_mesh_bend_further():
    """With linear elements the tip is at 111 mm; measured are 116 mm (Mazier et al. 2021)."""
    scene, theirs = authors_cantilever()
    X = np.asarray(scene.mesh.points)
    tip = np.flatnonzero(X[:, 2] > X[:, 2].max() - 1e-9)
    mesh = lj.quadratic(scene.mesh)
    held = np.flatnonzero(np.abs(np.asarray(mesh.points)[:, 2]) < 1e-9)
    quadratic = replace(
        scene,
        mesh=mesh,
        fixed=(lj.Fixed(nodes=jnp.asarray(held)),),
        solve=lj.Solve(steps=4, volumetric="mixed"),
    )
    sag = X[tip, 1].mean() - np.asarray(lj.simulate(quadratic).check().positions[-1])[tip, 1].mean()
    linear = X[tip, 1].mean() - theirs[tip, 1].mean()
    print(f"tip: linear {linear * 1e3:.2f} mm, quadratic {sag * 1e3:.2f} mm, measured 116 mm")
    assert linear < sag
