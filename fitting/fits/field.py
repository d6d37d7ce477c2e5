"""A map of stiffness from measured displacements: a smooth field of one number of the law, with its uncertainty.

The number of an element is the scene's number times exp(m). m is the element's mean of a nodal field (V,) with the
prior of `fitting.methods.prior`. The minimum of chi^2/2 + |z|^2/2 is sought by L-BFGS in the whitened z, with gradients
through the runs. The prior's standard deviation of m is the regulariser's weight: it grows until chi^2 comes down to
the number of measured components (discrepancy principle; Morozov 1966), or no longer falls. The uncertainty comes from
the Gauss-Newton Hessian I + J^T J. Lanczos iterations find its largest eigenvalues; each product needs a linearised run
and its transpose (Bui-Thanh et al. 2013).
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.sparse.linalg

from fitting.fits.scene_numbers import Problem, misfit, missing_or_none
from fitting.methods import prior as smooth
from fitting.methods.estimate import LARGEST_BIAS
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.scenes.scene import numbers_at

#: Standard deviations of ln(modulus) to try, from a nearly uniform body to a free one.
DEVIATIONS = (0.1, 0.2, 0.4, 0.8, 1.6)
#: If the next deviation lowers chi^2 by less than this part, the search ends.
_WORTH = 0.02
#: Largest |z| that is allowed, in standard deviations.
_BOUND = 8.0


class Field(NamedTuple):
    """The map and its uncertainty."""

    name: str
    log_factor: np.ndarray  # m (V,)
    modulus: np.ndarray  # modulus of the elements (E,)
    sd: np.ndarray  # of m at the nodes (V,), with the data
    prior_sd: np.ndarray  # of m at the nodes (V,), without data
    mesh_bias: np.ndarray | None  # part of m (V,) that the meshes cause: subtract it to correct; None: not known
    deviation: float  # standard deviation of the prior that was chosen
    length: float  # correlation length [m]
    chi2: float
    components: int
    reached: bool  # whether chi^2 came down to the number of components
    history: list[dict]  # one row per deviation: chi2, iterations, evaluations, seconds
    eigenvalues: np.ndarray  # of J^T J in whitened z: the data determine directions above 1
    codes: tuple[int, ...]
    seconds: float


def start_of(problem: Problem, name: str) -> jax.Array:
    """The numbers of the elements (E,) before the fit.

    Raises:
        InputError: the scenes have different meshes, or `name` is not a positive number.
    """
    scene = problem.scenes[0]
    E = scene.mesh.number_of_elements
    for other in problem.scenes[1:]:
        if other.mesh.number_of_elements != E or not np.allclose(other.mesh.points, scene.mesh.points):
            raise InputError("the scenes have different meshes: a field needs one mesh in all scenes")
    base = numbers_at(scene, name)
    if isinstance(base, tuple) or jnp.ndim(base) > 1 or (jnp.ndim(base) == 1 and base.shape != (E,)):
        raise InputError(f"a field of {name!r} needs one number: name one of the list, e.g. {name}.0")
    if not np.all(np.asarray(base) > 0):
        raise InputError(f"a field of {name!r} needs a positive number to begin with: change it in the scene")
    return jnp.broadcast_to(base, (E,))


def values_at(problem: Problem, name: str, base: jax.Array, m: jax.Array) -> dict[str, jax.Array]:
    """Numbers of the elements for the nodal field m (V,), by name."""
    corners = m[problem.scenes[0].mesh.tetrahedra]
    return {name: base * jnp.exp(jnp.mean(corners, axis=1))}


@partial(jax.jit, static_argnames="name")
def _cost_of_map(problem: Problem, base: jax.Array, m: jax.Array, name: str) -> Any:
    """chi^2/2, its gradient by m, and the codes."""

    def half(m):
        r, codes = misfit(problem, values_at(problem, name, base, m))
        return 0.5 * jnp.vdot(r, r), codes

    return jax.value_and_grad(half, has_aux=True)(m)


class _Search:
    """State of a search: the functions that L-BFGS calls, and the file from which a run is resumed."""

    def __init__(self, problem, name, base, p, file, progress):
        self.problem, self.name, self.base, self.p, self.file, self.progress = problem, name, base, p, file, progress
        self.history, self.k, self.z = [], 0, np.zeros(len(p.root_mass))
        self.best, self.evaluations, self.codes = np.inf, 0, ()
        self.marks = {
            "name": name,
            "length": float(p.scale),  # the prior's scale is a power of the length
            "noise": mark_of(*(d.sd for d in problem.data)),
            "displacements": mark_of(*(a for d in problem.data for a in d._replace(sd=d.step))),
            "scene": mark_of(base, *jax.tree.leaves(problem.scenes)),
        }

    def cost(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """(chi^2 + |z|^2)/2 and its gradient."""
        deviation = DEVIATIONS[self.k]
        m = deviation * smooth.field_at_nodes(self.p, z)
        (half, codes), g = _cost_of_map(self.problem, self.base, jnp.asarray(m), self.name)
        half, g = float(half), np.asarray(g)
        self.evaluations += 1
        if not (np.isfinite(half) and np.all(np.isfinite(g)) and not np.any(np.asarray(codes) == status.NOT_FINITE)):
            return 1e3 * (1 + z @ z + self.problem.components), z.copy()  # a large cost: the line search goes back
        self.chi2, self.codes = 2 * half, tuple(int(c) for c in codes)
        return half + 0.5 * float(z @ z), deviation * smooth.to_whitened(self.p, g) + z

    def iterated(self, z: np.ndarray) -> None:
        """Called by L-BFGS after each iteration."""
        self.z = z.copy()
        self.write()
        self.progress(self.k, self.chi2 / self.problem.components)

    def write(self) -> None:
        """Write the current point; the file is never left half written."""
        if self.file is None:
            return
        with whole(self.file) as new, h5py.File(new, "w") as f:
            f["z"], f["k"] = self.z, self.k
            f["history"] = np.array([[row[c] for c in _HISTORY] for row in self.history]).reshape(-1, len(_HISTORY))
            f.attrs.update(self.marks)

    def read(self) -> None:
        """Go on from the file of an earlier run.

        Raises:
            InputError: the file is damaged, or belongs to another problem.
        """
        if not self.file.is_file():
            return
        try:
            with h5py.File(self.file) as f:
                refuse_other(self.file, f.attrs, self.marks)
                self.z, self.k = f["z"][:], int(f["k"][()])
                self.history = [dict(zip(_HISTORY, map(float, row), strict=True)) for row in f["history"][:]]
        except (OSError, KeyError):  # not HDF5, or from another program
            raise InputError(f"{self.file} belongs to another fit: leave out --resume or name another --out") from None


_HISTORY = ("deviation", "chi2_per_component", "iterations", "evaluations", "seconds")


class MapOptions(NamedTuple):
    """Options of the search for a map, and of the file that keeps its progress."""

    max_iterations: int = 60  # L-BFGS iterations for each deviation of the prior
    modes: int = 60  # most directions of the field for which the uncertainty is computed
    file: Path | None = None  # HDF5 file for the point of every iteration; None: no file
    resume: bool = False  # begin from that file if it exists
    #: Called after each iteration with the index of the deviation and chi^2 per component.
    progress: Callable[[int, float], None] = lambda weight, chi2: None
    mesh_error: bool = True  # estimate the error of the meshes, and its change of the field (`mesh_bias`)


def estimate(
    problem: Problem,
    name: str = "law.mu",
    length: float = 0.03,
    options: MapOptions = MapOptions(),
    **changes: Any,
) -> Field:
    """The field of `name` that explains the data.

    Args:
        problem: scenes with one mesh, and the measurements.
        name: dotted name of a positive number of the law; the field begins at its value in the scenes.
        length: correlation length of the prior [m].
        options: how to search, see `MapOptions`.
        changes: fields of `options` by their names, for example ``max_iterations=40``.

    Raises:
        InputError: as `start_of`; or `file` belongs to another fit.
    """
    begin = time.perf_counter()
    base = start_of(problem, name)
    p = smooth.prior(problem.scenes[0].mesh, length)
    options = options._replace(**changes)
    search = _Search(problem, name, base, p, options.file, options.progress)
    if options.resume and options.file is not None:
        search.read()
    _deviations_in_turn(search, options.max_iterations)
    deviation = DEVIATIONS[search.k]
    m = deviation * smooth.field_at_nodes(p, search.z)
    search.cost(search.z)
    asked = _Asked.at(search, deviation, m)
    values, vectors = _measured_directions(asked, len(m), options.modes)
    before, after = smooth.variances(p, vectors, 1 / (1 + values))
    return Field(
        name=name,
        log_factor=m,
        modulus=np.asarray(values_at(problem, name, base, jnp.asarray(m))[name]),
        sd=deviation * np.sqrt(after),
        prior_sd=deviation * np.sqrt(before),
        mesh_bias=_bias_of_map(search, asked, m, values, vectors) if options.mesh_error else None,
        deviation=deviation,
        length=length,
        chi2=search.chi2,
        components=problem.components,
        reached=search.chi2 <= problem.components,
        history=search.history,
        eigenvalues=values,
        codes=search.codes,
        seconds=time.perf_counter() - begin,
    )


def _deviations_in_turn(search: _Search, max_iterations: int) -> None:
    """Try one deviation after another, each from the last field, until chi^2 is down to the noise."""
    while True:
        begin, before = time.perf_counter(), search.evaluations
        bounds = [(-_BOUND, _BOUND)] * len(search.z)
        options = {"maxiter": max_iterations, "maxcor": 20, "ftol": 1e-5}
        found = scipy.optimize.minimize(
            search.cost, search.z, jac=True, method="L-BFGS-B", bounds=bounds, options=options, callback=search.iterated
        )
        search.z = found.x
        search.cost(found.x)
        row = (
            DEVIATIONS[search.k],
            search.chi2 / search.problem.components,
            found.nit,
            search.evaluations - before,
            time.perf_counter() - begin,
        )
        search.history.append(dict(zip(_HISTORY, map(float, row), strict=True)))
        search.write()
        enough = search.chi2 <= search.problem.components
        last = [h["chi2_per_component"] for h in search.history[-2:]]
        idle = len(last) == 2 and last[1] > (1 - _WORTH) * last[0]
        if enough or idle or search.k + 1 == len(DEVIATIONS):
            return
        search.k += 1
        search.z = search.z * DEVIATIONS[search.k - 1] / DEVIATIONS[search.k]


class _Asked(NamedTuple):
    """The runs, linearised at the fitted field: products with J and its transpose, in whitened z."""

    p: smooth.Prior
    deviation: float
    push: Callable
    pull: Callable

    @classmethod
    def at(cls, search: _Search, deviation: float, m: np.ndarray) -> "_Asked":
        """Linearise the runs at the nodal field m (V,)."""
        name = search.name

        @jax.jit
        def residuals(m, problem, base):
            return misfit(problem, values_at(problem, name, base, m))[0]

        _, push = jax.linearize(lambda m: residuals(m, search.problem, search.base), jnp.asarray(m))
        pull = jax.jit(jax.linear_transpose(push, jnp.asarray(m)))
        return cls(search.p, deviation, jax.jit(push), pull)

    def gradient(self, r: np.ndarray | jax.Array) -> np.ndarray:
        """J^T r (V,) of residuals (n,)."""
        return self.deviation * smooth.to_whitened(self.p, np.asarray(self.pull(jnp.asarray(r))[0]))

    def product(self, z: np.ndarray) -> np.ndarray:
        """J^T J z (V,)."""
        dm = jnp.asarray(self.deviation * smooth.field_at_nodes(self.p, z.ravel()))
        return self.gradient(self.push(dm))


def _measured_directions(asked: _Asked, n: int, modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest eigenvalues (k,) of J^T J in whitened z, and their directions (n, k)."""
    k = min(modes, n - 2, jax.eval_shape(asked.push, jnp.zeros(n)).size)
    operator = scipy.sparse.linalg.LinearOperator((n, n), matvec=asked.product, dtype=float)
    # The prior determines directions with an eigenvalue far below 1: they need no accuracy.
    values, vectors = scipy.sparse.linalg.eigsh(operator, k=k, ncv=min(n, 2 * k + 1), tol=1e-2, v0=np.ones(n))
    return np.maximum(values[::-1], 0.0), vectors[:, ::-1]


def _bias_of_map(
    search: _Search, asked: _Asked, m: np.ndarray, values: np.ndarray, vectors: np.ndarray
) -> np.ndarray | None:
    """The change of the field m (V,) by the meshes: (I + J^T J)^-1 J^T times their error in the residuals."""
    left_out = missing_or_none(search.problem, values_at(search.problem, search.name, search.base, jnp.asarray(m)))
    if left_out is None or not np.all(np.isfinite(left_out)):
        return None
    n, shrink = len(m), values / (1 + values)

    def solved(z: np.ndarray) -> np.ndarray:
        return z - vectors @ (shrink * (vectors.T @ z))

    hessian, inverse = (
        scipy.sparse.linalg.LinearOperator((n, n), matvec=f, dtype=float)
        for f in (lambda z: z + asked.product(z), solved)
    )
    # The correction is of first order only, so a tolerance of 1 % is far below its own error.
    z, _ = scipy.sparse.linalg.cg(hessian, asked.gradient(left_out), rtol=1e-2, maxiter=30, M=inverse)
    return asked.deviation * smooth.field_at_nodes(asked.p, z)


def bias_sentence(found: Field) -> str | None:
    """A sentence if the mesh moves the map by more than its standard deviation at some node; None if it does not, or if
    this is not known.
    """
    if found.mesh_bias is None:
        return None
    largest, beyond = np.abs(found.mesh_bias).max(), np.abs(found.mesh_bias) > found.sd
    if largest > LARGEST_BIAS:
        return f"the mesh moves the map by a third or more ({largest:.0%}): too much to be corrected; refine the mesh"
    if not beyond.any():
        return None
    return (
        f"the mesh moves the map by up to {largest:.0%}, and by more than the standard deviation at "
        f"{beyond.mean():.0%} of the nodes: subtract mesh_bias from its logarithm, or refine the mesh"
    )
