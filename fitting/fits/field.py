"""A stiffness map from measured displacements: a smooth field of one parameter of the law, with its uncertainty.

The parameter of an element is the value in the scene times exp(m). Here m is the mean of a nodal field (V,) over the
element. `fitting.methods.prior` describes the prior of this field. The unknown is the whitened field z, whose entries
are independent with variance 1 in the prior. A Gauss-Newton method in a trust region (Steihaug 1983) minimises
(chi^2 + |z|^2)/2, where chi^2 is the sum of the squared residuals. J is the derivative of the residuals with respect to
z. The Hessian I + J^T J is never assembled: each product of the Hessian with a vector needs one linearised run and one
transposed run. No eigenvalue of this Hessian is below 1. The norm of the gradient is therefore an upper bound of the
distance to the minimum, in standard deviations of the map. The standard deviation of m in the prior sets the weight of
the regularisation. This standard deviation is increased until chi^2 is at most the number of measured components
(discrepancy principle; Morozov 1966), or until chi^2 no longer falls. The uncertainty is computed from the same
Hessian: Lanczos iterations find the largest eigenvalues of J^T J (Bui-Thanh et al. 2013).
"""

import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.sparse.linalg

from fitting.fits.scene_numbers import Problem, discretisation_errors, misfit, with_solvers
from fitting.methods import prior as smooth
from fitting.methods.estimate import LARGEST_BIAS
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.files import mark_of, refuse_other, whole
from liverjax.core.versions import versions
from liverjax.scenes.regions import set_by_regions
from liverjax.scenes.scene import numbers_at, with_parameters
from liverjax.scenes.scene_checks import check_before_run

#: Standard deviations of ln(modulus) in the prior, in the order in which they are tried. With the first, the body is
#: nearly uniform. With the last, the stiffness may vary strongly.
DEVIATIONS = (0.1, 0.2, 0.4, 0.8, 1.6)
#: If a step to the next larger standard deviation lowers chi^2 by less than this fraction, the search ends.
_WORTH = 0.02
#: The search ends if the norm of the gradient is below this value. The norm is an upper bound of the distance to the
#: minimum, in standard deviations of the map.
_NEAR = 0.05
#: The search has not converged if the distance to the minimum is above this value, in standard deviations of the map.
FAR = 0.1


class Field(NamedTuple):
    """The map and its uncertainty. The map is a nodal field m (V,), and the modulus is multiplied by exp(m)."""

    name: str
    log_factor: np.ndarray  # m (V,)
    modulus: np.ndarray  # modulus of the elements (E,); NaN in regions whose law has no such parameter
    sd: np.ndarray  # standard deviation (V,) of m at the nodes, from data and prior
    prior_sd: np.ndarray  # standard deviation (V,) of m at the nodes, from the prior alone
    mesh_bias: np.ndarray | None  # error of m (V,) due to the meshes; m minus this error is better; None: unknown
    time_step_bias: np.ndarray | None  # error of m (V,) due to the time steps; None: unknown, or no time steps
    deviation: float  # standard deviation of m in the prior, chosen from `DEVIATIONS`
    length: float  # correlation length of the prior [m]
    chi2: float
    components: int  # number of measured displacement components
    reached: bool  # whether chi^2 is at most the number of components
    distance: float  # distance to the minimum in standard deviations: length of the next Gauss-Newton step
    history: list[dict]  # one entry for each standard deviation of the prior, with the names in `_HISTORY`
    eigenvalues: np.ndarray  # largest eigenvalues of J^T J; the data determine the directions of z with values > 1
    codes: tuple[int, ...]
    seconds: float
    given: np.ndarray  # (E,) True where a [[region]] of the scene, not the map, sets the modulus
    level_sd: float  # standard deviation of a constant added to m, from the data alone, if m is otherwise known


def start_of(problem: Problem, name: str) -> jax.Array:
    """Return the value of the parameter in each element (E,) before the fit.

    Raises:
        InputError: the scenes have different meshes, the parameter is a list or not positive, it cannot have one value
            per element, or a [[region]] sets it in every element.
    """
    scene = problem.scenes[0]
    E = scene.mesh.number_of_elements
    for other in problem.scenes[1:]:
        same = other.mesh.order == scene.mesh.order and other.mesh.points.shape == scene.mesh.points.shape
        same = same and np.array_equal(other.mesh.tetrahedra, scene.mesh.tetrahedra)
        if not same or not np.allclose(other.mesh.points, scene.mesh.points):
            raise InputError("the scenes have different meshes: use one mesh in all scenes")
    base = numbers_at(scene, name)
    if isinstance(base, tuple) or jnp.ndim(base) > 1 or (jnp.ndim(base) == 1 and base.shape != (E,)):
        entry = f"one entry of the list, e.g. {name}.0" if isinstance(base, tuple) else "another parameter, e.g. law.mu"
        raise InputError(
            f"{name!r} is a list, and a field can multiply only one number, or one number per element: name {entry}"
        )
    if not np.all(np.asarray(base) > 0):
        raise InputError(f"a field of {name!r} must begin at a value above 0: change this value in the scene")
    if np.all(given_by_regions(problem, name)[0]):
        raise InputError(
            f"a [[region]] sets {name} in every element, so nothing is left to map: remove this parameter from a "
            "[[region]]"
        )
    values = jnp.broadcast_to(base, (E,))
    for each in problem.scenes:
        try:
            check_before_run(with_parameters(each, {name: values}))
        except (InputError, TypeError, ValueError):
            known = False
        else:
            known = not name.startswith("region.")
        if not known:
            raise InputError(
                f"{name!r} cannot have one value per element, so it has no map: name another parameter, e.g. law.mu"
            )
    return values


def given_by_regions(problem: Problem, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays (E,) for the elements. The first is True where a [[region]] sets the parameter in all scenes.
    The second contains the values that the regions of the first scene set; other values are NaN."""
    E = problem.scenes[0].mesh.number_of_elements
    each = [set_by_regions(scene.region, name, E) for scene in problem.scenes]
    return np.all([own for own, _ in each], axis=0), each[0][1]


def values_at(problem: Problem, name: str, base: jax.Array, m: jax.Array) -> dict[str, jax.Array]:
    """Compute the values (E,) of the parameter `name` in the elements from the nodal field m (V,). Return them as a
    dictionary with the key `name`."""
    corners = m[problem.scenes[0].mesh.tetrahedra]
    return {name: base * jnp.exp(jnp.mean(corners, axis=1))}


@partial(jax.jit, static_argnames="name")
def _linearised(problem: Problem, base: jax.Array, m: jax.Array, name: str) -> Any:
    """Return three results of the runs for the field m: the n residuals (n,), the linear map J from changes of m to
    changes of the residuals, and the status codes of the runs."""
    return jax.linearize(lambda m: misfit(problem, values_at(problem, name, base, m)), m, has_aux=True)


@jax.jit
def _pushed(J: Callable, dm: jax.Array) -> jax.Array:
    return J(dm)


@jax.jit
def _pulled(J: Callable, r: jax.Array, m: jax.Array) -> jax.Array:
    return jax.linear_transpose(J, m)(r)[0]


class _LinearRuns(NamedTuple):
    """The runs, linearised at a whitened field z. The methods compute products with the derivative J of the n residuals
    with respect to z, and with the transpose of J."""

    p: smooth.Prior
    deviation: float
    z: np.ndarray
    m: jax.Array
    r: np.ndarray  # residuals (n,)
    J: Callable  # linear map from changes of m to changes of r
    slope: np.ndarray  # J^T r (V,), where J is the derivative with respect to z
    codes: tuple[int, ...]

    @property
    def finite(self) -> bool:
        """Whether the residuals and their derivatives are finite."""
        numbers = np.all(np.isfinite(self.r)) and np.all(np.isfinite(self.slope))
        return bool(numbers and status.NOT_FINITE not in self.codes)

    @property
    def cost(self) -> float:
        """Cost (chi^2 + |z|^2)/2. If the runs are not finite, the cost is infinite and the search tries a shorter
        step."""
        return float(0.5 * (self.r @ self.r + self.z @ self.z)) if self.finite else np.inf

    def push(self, z: np.ndarray) -> jax.Array:
        """Return the product J z (n,)."""
        return _pushed(self.J, jnp.asarray(self.deviation * smooth.field_at_nodes(self.p, z.ravel())))

    def pull(self, r: np.ndarray | jax.Array) -> np.ndarray:
        """Return the product J^T r (V,) for residuals r (n,)."""
        return self.deviation * smooth.to_whitened(self.p, np.asarray(_pulled(self.J, jnp.asarray(r), self.m)))

    def gradient(self) -> np.ndarray:
        """Return the gradient (V,) of the cost with respect to z."""
        return self.z + (self.slope if self.finite else 0.0)

    def hessian(self, z: np.ndarray) -> np.ndarray:
        """Return the product (I + J^T J) z (V,)."""
        return z + (self.pull(self.push(z)) if self.finite else 0.0)


def _without_addresses(structure: object) -> str:
    """Return a string that describes the structure of scenes: the types of all objects, and the settings that are not
    numbers. The string has no memory addresses, so it is the same in every process."""
    return re.sub(r" at 0x[0-9a-f]+", "", str(structure))


class _Search:
    """State of a search, with the functions that the minimiser calls. A stopped search can continue from its file."""

    def __init__(
        self, problem: Problem, name: str, base: jax.Array, p: smooth.Prior, file: Path | None, progress: Callable
    ) -> None:
        self.problem, self.name, self.base, self.p, self.file, self.progress = problem, name, base, p, file, progress
        self.history: list[dict[str, float]] = []
        self.k, self.z = 0, np.zeros(len(p.root_mass))
        self.last: list[_LinearRuns] = []  # runs at the present trial z, and at the z before this trial step
        self.evaluations = 0
        self.marks = {
            "name": name,
            "length": float(p.scale),  # the scale of the prior is a power of the correlation length
            "noise": mark_of(*(d.sd for d in problem.data)),
            "displacements": mark_of(*(a for d in problem.data for a in d._replace(sd=d.step))),
            "search": "trust region",  # a search with another method may end at another map
            "scene": mark_of(base, *jax.tree.leaves(problem.scenes)),
            "law or settings": mark_of(_without_addresses(jax.tree.structure(problem.scenes))),
            "versions": mark_of(str(versions())),
        }

    def at(self, z: np.ndarray) -> _LinearRuns:
        """Return the runs, linearised at the whitened field z."""
        deviation = DEVIATIONS[self.k]
        for one in self.last:
            if one.deviation == deviation and np.array_equal(one.z, z):
                return one
        m = jnp.asarray(deviation * smooth.field_at_nodes(self.p, z))
        r, J, codes = _linearised(self.problem, self.base, m, self.name)
        self.evaluations += 1
        here = _LinearRuns(self.p, deviation, z.copy(), m, np.asarray(r), J, z, tuple(int(c) for c in codes))
        here = here._replace(slope=here.pull(here.r))
        # If this trial step is rejected, the next trial step begins again at the previous z.
        base = [one for one in self.last if np.array_equal(one.z, self.z)]
        self.last = [here, *(base or self.last)[:1]]
        return here

    def iterated(self, z: np.ndarray) -> None:
        """Save the new field z and report the progress. The minimiser calls this function after each iteration."""
        self.z = z.copy()
        self.write()
        r = self.at(self.z).r
        self.progress(self.k, float(r @ r) / self.problem.components)

    def write(self) -> None:
        """Write the current z and the history to the file. The file is replaced as a whole, so it is never half
        written."""
        if self.file is None:
            return
        with whole(self.file) as new, h5py.File(new, "w") as f:
            f["z"], f["k"] = self.z, self.k
            f["history"] = np.array([[row[c] for c in _HISTORY] for row in self.history]).reshape(-1, len(_HISTORY))
            f.attrs.update(self.marks)

    def read(self) -> None:
        """Continue from the file of an earlier search.

        Raises:
            InputError: the file is damaged, or belongs to another problem.
        """
        if self.file is None or not self.file.is_file():
            return
        try:
            with h5py.File(self.file) as f:
                refuse_other(self.file, f.attrs, self.marks)
                self.z, self.k = f["z"][:], int(f["k"][()])
                rows = f["history"][:]
            # Files of older versions do not state whether a search converged, so their last search continues.
            rows = np.pad(rows, ((0, 0), (0, max(0, len(_HISTORY) - rows.shape[1]))))
            self.history = [dict(zip(_HISTORY, map(float, row), strict=True)) for row in rows]
        except (OSError, KeyError):  # not an HDF5 file, or a file of another program
            raise InputError(f"{self.file} belongs to another fit: remove --resume, or give another --out") from None


#: Names of the numbers in an entry of the history. `converged` is 1 if the search ended at the minimum, and 0 if it
#: stopped before.
_HISTORY = ("deviation", "chi2_per_component", "iterations", "evaluations", "seconds", "converged")


class MapOptions(NamedTuple):
    """Options of the search for a map, and of the file with the progress of the search."""

    max_iterations: int = 60  # maximum number of iterations for each standard deviation of the prior
    modes: int = 60  # maximum number of eigenvectors of J^T J in the uncertainty
    file: Path | None = None  # HDF5 file with the progress, written after every iteration; None: no file
    resume: bool = False  # whether to continue the search in `file`, if this file exists
    #: Called after each iteration with the index of the standard deviation in `DEVIATIONS` and with chi^2 per
    #: component.
    progress: Callable[[int, float], None] = lambda weight, chi2: None
    mesh_error: bool = True  # whether to estimate the errors due to the meshes and the time steps


def estimate(
    problem: Problem,
    name: str = "law.mu",
    length: float = 0.03,
    options: MapOptions = MapOptions(),
    **changes: Any,
) -> Field:
    """Estimate the field of the parameter `name` from the data.

    Args:
        problem: scenes with one mesh, and the measurements.
        name: dotted name of a positive parameter of the law, for example law.mu. The search begins at the value in the
            scenes.
        length: correlation length of the prior [m].
        options: settings of the search, see `MapOptions`.
        changes: fields of `options` by their names, for example ``max_iterations=40``.

    Raises:
        InputError: the problem is invalid (see `start_of`), `file` belongs to another fit, or the simulation fails at
            the starting parameters.
    """
    begin = time.perf_counter()
    base, problem = start_of(problem, name), with_solvers(problem, {})
    p = smooth.prior(problem.scenes[0].mesh, length)
    options = options._replace(**changes)
    search = _Search(problem, name, base, p, options.file, options.progress)
    if options.resume and options.file is not None:
        search.read()
    _deviations_in_turn(search, options.max_iterations)
    here = search.at(search.z)
    if not here.finite:
        raise InputError(
            "the simulation fails at the parameters from which the search begins: run simulate on the scene to find "
            "the cause"
        )
    deviation, m = here.deviation, np.asarray(here.m)
    values, vectors = _measured_directions(here, len(m), options.modes)
    before, after = smooth.variances(p, vectors, 1 / (1 + values))
    slope, chi2 = here.gradient(), float(here.r @ here.r)
    given, its_values = given_by_regions(problem, name)
    return Field(
        name=name,
        log_factor=m,
        modulus=np.where(given, its_values, np.asarray(values_at(problem, name, base, here.m)[name])),
        given=given,
        sd=deviation * np.sqrt(after),
        prior_sd=deviation * np.sqrt(before),
        **(_biases_of_map(search, here, values, vectors) if options.mesh_error else _NO_BIASES),
        deviation=deviation,
        length=length,
        chi2=chi2,
        components=problem.components,
        reached=chi2 <= problem.components,
        distance=float(np.sqrt(max(slope @ _by_hessian(here, slope, values, vectors), 0.0))),
        history=search.history,
        eigenvalues=values,
        codes=here.codes,
        seconds=time.perf_counter() - begin,
        level_sd=1 / max(float(np.linalg.norm(_pushed(here.J, jnp.ones_like(here.m)))), 1e-300),
    )


def _deviations_in_turn(search: _Search, max_iterations: int) -> None:
    """Minimise the cost for larger and larger standard deviations of the prior. Stop when chi^2 is at most the number
    of components, or when chi^2 no longer falls. Each search begins at the result of the previous search."""
    while True:
        # If the program was stopped after this search had finished, the history already has the entry of this search.
        # A search that stopped before its minimum, for example at its limit of iterations, continues.
        finished = len(search.history) > search.k and search.history[search.k]["converged"] > 0
        if not finished:
            search.history = [*search.history[: search.k], _minimised(search, max_iterations)]
            search.write()
        last = [h["chi2_per_component"] for h in search.history[-2:]]
        idle = len(last) == 2 and last[1] > (1 - _WORTH) * last[0]
        if last[-1] <= 1 or idle or search.k + 1 == len(DEVIATIONS):
            return
        search.k += 1
        search.z = search.z * DEVIATIONS[search.k - 1] / DEVIATIONS[search.k]


def _minimised(search: _Search, max_iterations: int) -> dict[str, float]:
    """Find the minimum of the cost for the present standard deviation of the prior, and return an entry of the
    history."""
    begin, before = time.perf_counter(), search.evaluations
    found = scipy.optimize.minimize(
        lambda z: search.at(z).cost,
        search.z,
        jac=lambda z: search.at(z).gradient(),
        hessp=lambda z, v: search.at(z).hessian(v),
        method="trust-ncg",
        callback=search.iterated,
        options={"maxiter": max_iterations, "gtol": _NEAR},
    )
    search.z = found.x
    r = search.at(found.x).r
    chi2, seconds = float(r @ r) / search.problem.components, time.perf_counter() - begin
    row = (DEVIATIONS[search.k], chi2, found.nit, search.evaluations - before, seconds, found.success)
    return dict(zip(_HISTORY, map(float, row), strict=True))


def _measured_directions(here: _LinearRuns, n: int, modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the k largest eigenvalues (k,) of J^T J and their eigenvectors (n, k), for the n entries of z. k is
    `modes`, or smaller if z has too few entries or if there are too few residuals."""
    k = min(modes, n - 2, len(here.r))
    operator = scipy.sparse.linalg.LinearOperator((n, n), matvec=lambda z: here.pull(here.push(z)), dtype=float)
    # The prior determines the directions with an eigenvalue far below 1. So these eigenvalues need only a low accuracy.
    values, vectors = scipy.sparse.linalg.eigsh(operator, k=k, ncv=min(n, 2 * k + 1), tol=1e-2, v0=np.ones(n))
    return np.maximum(values[::-1], 0.0), vectors[:, ::-1]


def _by_hessian(here: _LinearRuns, g: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return (I + J^T J)^-1 g (V,) for a vector g (V,), by conjugate gradients with a relative tolerance of 1 %. This
    is accurate enough for first-order estimates. The preconditioner is computed from the eigenvalues and eigenvectors
    of J^T J."""
    n, shrink = len(g), values / (1 + values)

    def solved(z: np.ndarray) -> np.ndarray:
        return z - vectors @ (shrink * (vectors.T @ z))

    hessian, inverse = (
        scipy.sparse.linalg.LinearOperator((n, n), matvec=f, dtype=float) for f in (here.hessian, solved)
    )
    return scipy.sparse.linalg.cg(hessian, g, rtol=1e-2, maxiter=30, M=inverse)[0]


_NO_BIASES: dict[str, np.ndarray | None] = {"mesh_bias": None, "time_step_bias": None}


def _biases_of_map(
    search: _Search, here: _LinearRuns, values: np.ndarray, vectors: np.ndarray
) -> dict[str, np.ndarray | None]:
    """Return the errors of the field m (V,) due to the meshes and due to the time steps. The error of z is
    (I + J^T J)^-1 J^T times the errors of the residuals, and m is computed from z. Unknown errors are None."""
    biases = dict(_NO_BIASES)
    errors = discretisation_errors(search.problem, values_at(search.problem, search.name, search.base, here.m))
    for kind, error in errors._asdict().items():
        if error is not None:
            z = _by_hessian(here, here.pull(error), values, vectors)
            biases[f"{kind}_bias"] = here.deviation * smooth.field_at_nodes(here.p, z)
    return biases


def distance_sentence(found: Field) -> str | None:
    """Return a warning if the search stopped before the minimum, otherwise None."""
    if found.distance <= FAR:
        return None
    return (
        f"the search stopped {found.distance:.2g} standard deviations of the map away from the minimum: give --resume "
        "with more --iterations, or a smaller [solve] tolerance"
    )


#: The data do not determine the level of the map in two cases: the standard deviation of ln(modulus) exceeds this value
#: at every mapped node, or `level_sd` exceeds this value. The second test is needed because the prior limits the
#: standard deviation at the nodes.
OPEN = 0.5


def level_sentence(found: Field) -> str | None:
    """Return a warning if the data do not determine the level of the map (`OPEN`), otherwise None."""
    least = float(np.min(found.sd))
    if least > OPEN:
        size = f"at every mapped node, the modulus is uncertain by a factor of {np.exp(least):.2g} or more"
    elif found.level_sd > OPEN:
        size = "only the prior ties the mean modulus to the value in the scene, and the standard deviations assume this"
    else:
        return None
    return (
        f"the data do not determine the level of the map: {size}. Displacements alone determine only ratios of moduli, "
        "so give a traction or a measured force"
    )


def map_bias_sentences(found: Field) -> list[str]:
    """Return at most two warnings: one about the mesh error, and one about the time step error. There is a warning
    about an error only if the error changes the map at some node by more than the standard deviation at this node."""
    sources = (
        (found.mesh_bias, "mesh", "mesh_bias", "refine the mesh"),
        (found.time_step_bias, "time step", "time_step_bias", "use smaller time steps"),
    )
    return [said for bias, *words in sources if bias is not None and (said := _bias_sentence(found.sd, bias, words))]


def _bias_sentence(sd: np.ndarray, bias: np.ndarray, words: Sequence[str]) -> str | None:
    what, name, remedy = words
    beyond = np.abs(bias) > sd
    if not beyond.any():
        return None
    largest = np.abs(bias)[beyond].max()
    if largest > LARGEST_BIAS:
        return f"the {what} error changes the map by up to {largest:.0%}, which is too much to correct: {remedy}"
    return (
        f"the {what} error changes the map by up to {largest:.0%}, and by more than the standard deviation at "
        f"{beyond.mean():.0%} of the nodes: subtract {name} from the logarithm of the map, or {remedy}"
    )
