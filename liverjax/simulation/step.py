"""Solve the equations of one load or time step of a scene, and return the next state."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from liverjax import laws
from liverjax.core import status
from liverjax.core.struct import Number, replace
from liverjax.elements.gradients import volume_ratios
from liverjax.physics import darcy
from liverjax.physics.base import End, NodalForce
from liverjax.physics.darcy import Guess
from liverjax.physics.elasticity import Elastic
from liverjax.simulation import mixed_system, tangent
from liverjax.simulation.equations import (
    Equations,
    State,
    advanced,
    energy,
    flowing_lack,
    flowing_pressure,
    forces,
    positions,
    reported_forces,
    residual,
    settled,
    unknowns,
)
from liverjax.solvers import block_matrix, step_cutting
from liverjax.solvers.krylov import (
    Earlier,
    conjugate_gradients,
    one_by_one,
    stabilised_biconjugate_gradients,
    started,
    true_residual,
)
from liverjax.solvers.problem import Beside, Kept, Potential, Problem, StepOptions, StepStatistics
from liverjax.tensors.matrices import deformation_gradient, determinant


def problem_of(e: Equations) -> Problem:
    """Return the problem that `step_cutting.solve` solves to find the positions at the end of the step."""
    potential = None
    if e.scene.solve.robust != "off":
        potential = Potential(
            energy=partial(energy, e),
            definite=partial(_definite, e),
            volume=lambda q, s: jnp.min(determinant(deformation_gradient(e.mesh, positions(e, q, s)))),
            surrogate=None if isinstance(e.scene.law, laws.StableNeoHookean) else problem_of(_finite(e)),
            rest=_rest(e) if e.scene.solve.kind == "static" else None,
            settled=None if e.mixed is None else partial(settled, e),
            positions=None if e.mixed is None else 3 * e.mesh.number_of_nodes,
            eliminates=tangent.eliminates_pressures(e),
        )
    return Problem(
        residual=partial(residual, e),
        tangent=partial(_tangent, e, "true"),
        solve=partial(tangent.solve, e),
        preconditioner=partial(tangent.preconditioner, e),
        # If nodes rotate together by an unknown angle, the tangent is exact only for small rotations. So it cannot be
        # used for derivatives.
        adjoint=partial(adjoint, e) if e.conservative and all(nodes.linear for nodes in e.free.tied) else None,
        symmetric=e.conservative and e.mixed is None,  # the preconditioner of pressure unknowns is not symmetric
        moved=len(e.scene.displaced) > 0 or e.scene.solve.kind == "static",
        roundoff=e.roundoff,
        kinks=any(a.kinked for a in e.nodal),
        beside=_flowing(e),
        potential=potential,
        numbers=e,
    )


def beginning(first: Equations, tangent_too: bool = False) -> tuple[Kept, tangent.Tangent | None]:
    """Return an empty `Kept` for a run, and a tangent. `first`: equations of the first step of the run. The tangent is
    computed at the positions at the beginning of the run. It is None unless `tangent_too` is true.
    """
    method, q = problem_of(first), unknowns(first, first.state.x)
    kept = step_cutting.nothing_kept(method, q)
    if not tangent_too:
        return kept, None
    one = jnp.ones((), q.dtype)
    return kept, method.tangent(q, one, method.residual(q, one)[2], None)


def _flowing(e: Equations) -> Beside | None:
    """Return a `Beside` with the pressures of a flowing fluid as additional unknowns; None without a flowing fluid."""
    volume: Any = e.volume
    if volume is None or volume.flow is None:
        return None
    return Beside(volume.fluid.pressure, partial(flowing_pressure, e), Guess, partial(flowing_lack, e))


def _tangent(
    e: Equations, kind: tangent.Kind, q: jax.Array, s: Number, pressure: jax.Array | None, near: Any
) -> tangent.Tangent:
    return tangent.tangent(e, pressure, positions(e, q, s), s, near, kind)


def _definite(
    e: Equations, q: jax.Array, s: Number, pressure: jax.Array | None, near: Any, taken: jax.Array | None = None
) -> tangent.Tangent:
    kind = e.scene.solve.robust
    return _tangent(e, kind if taken is None else (kind, taken), q, s, pressure, near)


def _rest(e: Equations) -> tuple[jax.Array, jax.Array]:
    """Return the unknowns of the reference shape, and a flag. The flag is true in the first step, if this step begins
    at positions that differ from the reference shape."""
    points = e.mesh.points
    return unknowns(e, points), (e.k == 1) & jnp.any(e.free.vectors(e.state.x - points) != 0)


def _finite(e: Equations) -> Equations:
    """Return the equations of the same body with a stable neo-Hookean law, whose energy is finite everywhere.

    The force terms at nodes stay the same.
    """
    law = e.scene.law
    mu = law.shear_modulus()
    own = [p.bulk_modulus() for p in e.physics if p.bulk_modulus() is not None]
    bulk = own[0] if own else law.bulk_modulus()
    stable = laws.StableNeoHookean(mu=mu, lame_lambda=jnp.maximum(bulk - 2 / 3 * mu, mu))
    nodal = tuple(a if isinstance(a, NodalForce) else None for a in e.acting)
    return e._replace(scene=replace(e.scene, law=stable), acting=(Elastic(law=stable), *nodal))


def step(
    e: Equations, kept: Kept | None = None, near: Any = None, differentiable: bool = True
) -> tuple[State, jax.Array, StepStatistics, Kept]:
    """Solve a step. Return the next state, the reactions (V, 3) [N], statistics, and the `Kept` for the next step.

    The argument `kept` contains the tangent of the last step. The linear solves for derivatives use the coarse space of
    the tangent `near`, if it is given.
    """
    scene, x, solve = e.scene, e.state.x, e.scene.solve
    options = StepOptions(
        tolerance=jax.lax.stop_gradient(solve.tolerance),
        max_iterations=solve.newton_iterations,
        one_step=solve.newton == "one_step",
        differentiable=differentiable,
    )
    # With inertia, the first guess is a motion at constant velocity. It is not used with prescribed motion, or in the
    # one-step scheme (book chapter).
    ahead = [guess for guess in (a.predicted() for a in e.nodal) if guess is not None]
    guess = unknowns(e, ahead[0]) if ahead and not scene.displaced and not options.one_step else None
    problem = problem_of(e)
    q, statistics, kept = step_cutting.solve(problem, unknowns(e, x), options, guess, kept, near)
    known = None if kept.beside is None or problem.adjoint is not None else Guess(kept.beside, 1.0)
    f = forces(e, q, jnp.ones((), x.dtype), known, None if problem.adjoint is None else kept.beside)
    projected = e.free.normals is not None or e.free.tied
    total, by_end_forces = reported_forces(e, f.total, f.x)
    reactions = total - e.free.vectors(total, f.x) if projected else (1 - e.free.mask) * total
    found = (statistics.status == status.CONVERGED) | (statistics.status == status.ONE_STEP)
    inverted = found & jnp.any(volume_ratios(e.mesh, f.x) <= 0)
    statistics = statistics._replace(status=jnp.where(inverted, status.INVERTED, statistics.status))
    return advanced(e, End(f.x, f.F, f.pressure), by_end_forces), reactions, statistics, kept


def adjoint(
    e: Equations,
    K: tangent.Tangent,
    b: jax.Array,
    tolerance: Number,
    max_iterations: int,
    earlier: Earlier | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solve K x = b together with the pressures, for derivatives.

    Return x, the right-hand side, and the norm of the residual divided by the norm of the right-hand side.

    With a flowing fluid, x also contains the pressures of the fluid, and b contains the forces and the negative volume
    balance. The returned right-hand side (3 V,) is then what remains of b after the elimination of the pressures.
    Without a flowing fluid, the returned right-hand side is b. Iterations begin with a combination of `earlier` solves
    if this reduces the residual. Follower loads are not allowed. On a CPU, the columns of a Jacobian are solved one
    after another.
    """
    if e.scene.solve.linear_solver == "direct":
        return _adjoint(e, K, b, (tolerance, max_iterations), earlier)
    arrays, tree = jax.tree.flatten((e, K, b, tolerance, earlier))

    def solved(*arrays: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        e, K, b, tolerance, earlier = jax.tree.unflatten(tree, arrays)
        return _adjoint(e, K, b, (tolerance, max_iterations), earlier)

    found: tuple[jax.Array, jax.Array, jax.Array] = one_by_one(solved)(*arrays)
    return found


def _adjoint(
    e: Equations, K: tangent.Tangent, b: jax.Array, limits: tuple[Number, int], earlier: Earlier | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    tolerance, max_iterations = limits
    volume = tangent.volume_with_pressures(e)
    flows = e.mixed is None and volume is not None and volume.flow is not None
    if flows:
        return _with_flow(e, K, b, limits, earlier)
    apply = tangent.product(e, K, exactly=True)
    if e.scene.solve.linear_solver == "direct":
        x = tangent.factorised_solution(e, K, b)
        return x, b, true_residual(apply, b, x)
    method = conjugate_gradients if e.mixed is None else stabilised_biconjugate_gradients

    def iterated(b: jax.Array, tolerance: Number) -> tuple[jax.Array, jax.Array]:
        x, s = method(apply, b, tangent.preconditioner(e, K), tolerance, max_iterations)
        return x, s.residual

    if earlier is None:
        x, residual = iterated(b, tolerance)
    else:
        x, residual = started(iterated, apply, b, earlier.combined(b), tolerance)
    return x, b, residual


#: For `_with_flow`: tolerances of the solves for displacements and for pressures, maximum number of refinements, and
#: maximum number of successive refinements that do not reduce the residual. Far from the solution an inaccurate solve
#: for pressures may increase the residual.
_INNER, _INNER_PRESSURE, _REFINEMENTS, _VAIN = 5e-2, 1e-2, 60, 3


def _with_flow(
    e: Equations, K: tangent.Tangent, b: jax.Array, limits: tuple[Number, int], earlier: Earlier | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Solve the equations of `adjoint` for the mixed system with a flowing fluid, by iterative refinement.

    Displacements and pressures are refined together, so that solves for pressures with a low accuracy are enough.
    """
    volume: Any = tangent.volume_with_pressures(e)
    n, flow, (tolerance, max_iterations) = 3 * e.mesh.number_of_nodes, volume.flow, limits
    loose = flow._replace(tolerance=_INNER_PRESSURE)
    given = (flow.mask - 1) * b[n:]  # part of the solution: the entries where the pressure is given

    def left(x: jax.Array, P: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the out-of-balance forces for x and P + dP. Also return dP, the change of P that balances the
        volumes."""
        motion = e.free.columns(block_matrix.columns(x))
        force, balance = mixed_system.balances(e.mesh, K.matrix, motion)
        balance = balance - b[n:] - darcy.flow_product(flow, P)
        dP = mixed_system.pressure_change(e.mesh, loose, K.matrix, balance, exactly=True)
        force = block_matrix.sums(force, mixed_system.pulled(e.mesh, K.matrix, -P - dP))
        return b[:n] - tangent.flat_free(e, tangent.with_nodal_products(e, K, motion, force)), dP

    def go_on(c):
        _, _, r, _, _, vain, k = c
        return (jnp.linalg.norm(r) > tolerance * scale) & (vain < _VAIN) & (k < _REFINEMENTS)

    def step(c):
        x, P, r, dP, least, vain, k = c
        size = jnp.linalg.norm(r)
        # In the last refinement, the linear solve is only as accurate as the tolerance requires.
        inner = jnp.clip(0.3 * tolerance * scale / size, _INNER, 0.5)
        x, P = x + tangent.solve(e, K, r, inner, max_iterations)[0], P + dP
        r, dP = left(x, P)
        least = jnp.minimum(least, size)
        return x, P, r, dP, least, jnp.where(jnp.linalg.norm(r) < least, 0, vain + 1), k + 1

    load, begin = left(jnp.zeros_like(b[:n]), jnp.zeros_like(b[n:]))
    size = jnp.linalg.norm(load)
    scale = jnp.where(size > 0, size, 1.0)
    nothing = jnp.zeros_like(b)
    if e.scene.solve.linear_solver == "direct":
        near = tangent.factorised_solution(e, K, b)
        done = jnp.array(_REFINEMENTS)
    else:
        near = nothing if earlier is None else earlier.combined(load)
        done = jnp.array(0)
    x, P = near[:n], flow.mask * near[n:]
    r, dP = left(x, P)
    helps = jnp.linalg.norm(r) < size
    x, P, r, dP = (jnp.where(helps, a, b) for a, b in zip((x, P, r, dP), (0 * x, 0 * P, load, begin), strict=True))
    start = (x, P, r, dP, jnp.linalg.norm(r), jnp.array(0), done)
    x, P, r, dP, *_ = jax.lax.while_loop(go_on, step, start)
    return jnp.concatenate([x, P + dP + given]), load, jnp.linalg.norm(r) / scale
