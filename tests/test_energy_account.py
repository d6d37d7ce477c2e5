"""A body that falls on a plane, step by step: kinetic, elastic and contact energy, height, and the scheme's loss.

The energies are computed in NumPy from positions, masses and the law's energy, independently of the run.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.mesh.nodal import nodal_volumes

pytestmark = pytest.mark.quick_to_compile

SIDE, DENSITY, GRAVITY, SOFT, FALL = 0.1, 1000.0, 9.81, 1e6, 5e-3
LAW = lj.laws.NeoHookean(mu=1e5, bulk=3e5)
#: Duration of a run [s]: the cube falls, is compressed, and leaves the plane.
SECONDS = 0.09
#: Time steps [s] from which the order is computed. A step in which an edge touches or leaves has a larger error.
STEPS = (1e-3, 2.5e-4)


def falling(integrator: str, dt: float) -> lj.Scene:
    """A cube as stiff as the contact, 5 mm above a slightly inclined plane, so that its edges touch one after the
    other.
    """
    mesh = lj.shapes.box((SIDE, SIDE, SIDE), (1, 1, 1))
    normal = np.array([0.05, 0.02, 1.0])
    normal = normal / np.linalg.norm(normal)
    place = np.array([0.0, 0.0, -FALL])
    plane = lj.Obstacle(
        triangles=jnp.asarray(lj.boundary.boundary_triangles(mesh, mesh.node_sets["z_min"])),
        position=jnp.asarray(place),
        axis=jnp.asarray(normal),
        stiffness=SOFT,
    )
    solve = lj.Solve(kind="dynamic", dt=dt, steps=round(SECONDS / dt), integrator=integrator, tolerance=1e-10)
    weight = lj.Body(density=DENSITY, gravity=jnp.array([0.0, 0.0, -GRAVITY]))
    return lj.Scene(mesh=mesh, law=LAW, body=weight, physics=(plane,), solve=solve)


def velocities(x: np.ndarray, dt: float, integrator: str, weight: np.ndarray) -> np.ndarray:
    """Return velocities (T + 1, V, 3) from positions (T + 1, V, 3) of a body that begins at rest in free fall."""
    v, a = [np.zeros_like(x[0])], weight
    for before, after in itertools.pairwise(x):
        if integrator == "euler":
            v.append((after - before) / dt)
            continue
        new = 4 * (after - before - dt * v[-1]) / dt**2 - a
        v.append(v[-1] + 0.5 * dt * (a + new))
        a = new
    return np.stack(v)


def account(scene: lj.Scene, stiffer: float = 1.0) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the energy imbalance of each step [J], and the energies (T + 1,) [J].

    `stiffer` above 1 adds a mistake to the contact energy.
    """
    result, plane = lj.simulate(scene).check(), scene.physics[0]
    rest, mass = np.asarray(scene.mesh.points), DENSITY * np.asarray(nodal_volumes(scene.mesh))
    x = np.concatenate([rest[None], np.asarray(result.positions)])
    weight = np.broadcast_to(np.array([0.0, 0.0, -GRAVITY]), rest.shape)
    v = velocities(x, float(scene.solve.dt), scene.solve.integrator, weight)
    tets = np.asarray(scene.mesh.tetrahedra)
    D = rest[tets[:, 1:]] - rest[tets[:, :1]]
    F = np.einsum("teai,eaj->teij", x[:, tets[:, 1:]] - x[:, tets[:, :1]], np.linalg.inv(D).transpose(0, 2, 1))
    volume = np.linalg.det(D) / 6
    J, I1 = np.linalg.det(F), np.sum(F**2, axis=(2, 3))
    mu, bulk = float(LAW.mu), float(LAW.bulk)
    W = mu / 2 * (J ** (-2 / 3) * I1 - 3) + bulk / 2 * (J - 1) ** 2
    triangles = np.asarray(plane.triangles)
    corners = np.full((3, 3), 1 / 6) + 0.5 * np.eye(3)
    at = np.einsum("qa,tmai->tmqi", corners, x[:, triangles])
    depth = np.minimum((at - np.asarray(plane.position)) @ np.asarray(plane.axis), 0.0)
    area = 0.5 * np.linalg.norm(np.cross(*(rest[triangles[:, k]] - rest[triangles[:, 0]] for k in (1, 2))), axis=1)
    energies = {
        "kinetic": 0.5 * np.einsum("v,tvi->t", mass, v**2),
        "elastic": W @ volume,
        "contact": 0.5 * stiffer * SOFT * np.einsum("m,tmq->t", area / 3, depth**2),
        "height": GRAVITY * x[..., 2] @ mass,
    }
    lost = 0.5 * np.einsum("v,tvi->t", mass, np.diff(v, axis=0) ** 2) if scene.solve.integrator == "euler" else 0.0
    return np.diff(sum(energies.values())) + lost, energies


@pytest.mark.slow
@pytest.mark.parametrize(("integrator", "order"), [("newmark", 2), ("euler", 1)])
def test_every_step_of_a_fall_balances(integrator, order, verified):
    """The sum of the imbalances falls with the scheme's order, and is small relative to the energy of the fall.

    Implicit Euler loses half of m |dv|^2 in a step, Newmark's average acceleration nothing. The remaining imbalance
    comes from the curvature of the potentials: a step uses their derivative at its end, or the mean of both ends.
    """
    fallen = DENSITY * SIDE**3 * GRAVITY * FALL
    sums = []
    for dt in STEPS:
        left, energies = account(falling(integrator, dt))
        sums.append(float(np.abs(left).sum()) / fallen)
        # All parts matter: the cube is compressed, and the plane stores its share.
        assert energies["elastic"].max() > 0.02 * fallen and energies["contact"].max() > 0.2 * fallen
    observed = np.log(sums[0] / sums[1]) / np.log(STEPS[0] / STEPS[1])
    assert observed > order - 0.3
    assert sums[1] < {1: 0.1, 2: 1e-3}[order]
    verified(f"fall on a plane, energy of every step, {integrator}", "balance", sums[1], 1.0, observed)
    # With a contact energy that is a tenth too large, no step length balances.
    wrong = [float(np.abs(account(falling(integrator, dt), 1.1)[0]).sum()) / fallen for dt in STEPS]
    assert wrong[1] > 3 * sums[1] if integrator == "newmark" else wrong[1] > sums[1]
