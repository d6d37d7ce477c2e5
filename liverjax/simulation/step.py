"""One load or time step of a scene: it solves the equations and returns the next state."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from liverjax import laws
from liverjax.core import status
from liverjax.core.struct import Number, replace
from liverjax.elements.gradients import volume_ratios
from liverjax.physics.base import End, NodalForce
from liverjax.physics.darcy import Guess
from liverjax.physics.elasticity import Elastic
from liverjax.simulation import tangent
from liverjax.simulation.equations import (
    Equations,
    State,
    advanced,
    energy,
    flowing_pressure,
    forces,
    positions,
    residual,
    settled,
    unknowns,
)
from liverjax.solvers import step_cutting
from liverjax.solvers.problem import Beside, Kept, Potential, Problem, StepOptions, StepStatistics
from liverjax.tensors.matrices import deformation_gradient, determinant


def problem_of(e: Equations) -> Problem:
    """How `step_cutting.solve` finds the end of the step."""
    potential = None
    if e.scene.solve.robust != "off":
        potential = Potential(
            energy=partial(energy, e),
            definite=partial(_tangent, e, e.scene.solve.robust),
            volume=lambda q, s: jnp.min(determinant(deformation_gradient(e.mesh, positions(e, q, s)))),
            surrogate=None if isinstance(e.scene.law, laws.StableNeoHookean) else problem_of(_finite(e)),
            rest=_rest(e) if e.scene.solve.kind == "static" else None,
            settled=None if e.mixed is None else partial(settled, e),
            positions=None if e.mixed is None else 3 * e.mesh.number_of_nodes,
        )
    return Problem(
        residual=partial(residual, e),
        tangent=partial(_tangent, e, "true"),
        solve=partial(tangent.solve, e),
        preconditioner=partial(tangent.preconditioner, e),
        # Where nodes move together on circles, the tangent is that of small turns: near, but not the derivative.
        adjoint=partial(tangent.adjoint, e) if e.conservative and not e.free.tied else None,
        symmetric=e.conservative,
        moved=len(e.scene.displaced) > 0 or e.scene.solve.kind == "static",
        roundoff=e.roundoff,
        beside=_flowing(e),
        potential=potential,
    )


def beginning(first: Equations, tangent_too: bool = False) -> tuple[Kept, tangent.Tangent | None]:
    """The empty `Kept` of a run that begins with these equations, and the tangent at its beginning where asked for."""
    method, q = problem_of(first), unknowns(first, first.state.x)
    kept = step_cutting.nothing_kept(method, q)
    if not tangent_too:
        return kept, None
    one = jnp.ones((), q.dtype)
    return kept, method.tangent(q, one, method.residual(q, one)[2], None)


def _flowing(e: Equations) -> Beside | None:
    """Pressures that flow, where they depend on motion."""
    volume: Any = e.volume
    if volume is None or volume.flow is None:
        return None
    return Beside(volume.fluid.pressure, partial(flowing_pressure, e), Guess)


def _tangent(
    e: Equations, kind: str, q: jax.Array, s: Number, pressure: jax.Array | None, near: Any
) -> tangent.Tangent:
    return tangent.tangent(e, pressure, positions(e, q, s), s, near, kind)


def _rest(e: Equations) -> tuple[jax.Array, jax.Array]:
    """The reference shape, and whether the first step begins at another one, which without inertia is a guess."""
    points = e.mesh.points
    return unknowns(e, points), (e.k == 1) & jnp.any(e.free.vectors(e.state.x - points) != 0)


def _finite(e: Equations) -> Equations:
    """The same body of stable neo-Hookean material. Of the other physics it keeps those that act at nodes."""
    law = e.scene.law
    mu = law.shear_modulus()
    own = [p.bulk_modulus() for p in e.physics if p.bulk_modulus() is not None]
    bulk = own[0] if own else law.bulk_modulus()
    stable = laws.StableNeoHookean(mu=mu, lame_lambda=jnp.maximum(bulk - 2 / 3 * mu, mu))
    nodal = tuple(a if isinstance(a, NodalForce) else None for a in e.acting)
    return e._replace(scene=replace(e.scene, law=stable), acting=(Elastic(law=stable), *nodal))


def step(e: Equations, kept: Kept | None = None, near: Any = None) -> tuple[State, jax.Array, StepStatistics, Kept]:
    """The next state, the reactions (V, 3) [N], what the solve took and the tangent for the next step.

    `kept` is the tangent of the last step; derivatives may take the coarse space of `near`.
    """
    scene, x, solve = e.scene, e.state.x, e.scene.solve
    options = StepOptions(
        tolerance=jax.lax.stop_gradient(solve.tolerance),
        max_iterations=solve.newton_iterations,
        one_step=solve.newton == "one_step",
    )
    # Straight on where there is inertia; one step of Newton starts at x, as printed.
    ahead = [guess for guess in (a.predicted() for a in e.nodal) if guess is not None]
    guess = unknowns(e, ahead[0]) if ahead and not scene.displaced and not options.one_step else None
    q, statistics, kept = step_cutting.solve(problem_of(e), unknowns(e, x), options, guess, kept, near)
    f = forces(e, q, jnp.ones((), x.dtype), None if kept.beside is None else Guess(kept.beside, 1.0))
    projected = e.free.normals is not None or e.free.tied
    reactions = f.total - e.free.vectors(f.total, f.x) if projected else (1 - e.free.mask) * f.total
    found = (statistics.status == status.CONVERGED) | (statistics.status == status.ONE_STEP)
    inverted = found & jnp.any(volume_ratios(e.mesh, f.x) <= 0)
    statistics = statistics._replace(status=jnp.where(inverted, status.INVERTED, statistics.status))
    return advanced(e, End(f.x, f.F, f.pressure)), reactions, statistics, kept
