"""Gradient check of a material law: derivatives, objectivity, rest state, limits and stable ranges."""

import importlib.util
import inspect
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from liverjax import laws
from liverjax.core.errors import InputError
from liverjax.laws import Law, autodiff
from liverjax.laws.stability_check import EXACT_LIMIT, Row, as_numbers, jump_rows, stability_rows

#: Steps of the difference quotients: norms of the change of the deformation gradient F.
STEPS = 10.0 ** -np.arange(1.0, 10.5, 0.5)
#: Limit for the relative error of difference quotients. Their roundoff and truncation errors are at least about
#: eps^(2/3) of the largest term (eps: machine precision). The factor 1000 allows for large terms that cancel.
DIFFERENCE_LIMIT = 1e3 * np.finfo(float).eps ** (2 / 3)
#: Ranges of stretch for the comparisons. The narrower ranges are for laws with a limiting stretch, e.g. Gent's law.
_MODERATE, _NARROWER = (0.7, 1.4), ((0.85, 1.18), (0.95, 1.05), (0.99, 1.01))


class Check(NamedTuple):
    """Result of the gradient check: the rows of the table, and the data of the figure."""

    law: Law
    rows: list[Row]
    steps: np.ndarray
    difference_errors: dict[str, np.ndarray]
    stable: dict[str, tuple[float, float]]

    @property
    def failed(self) -> list[Row]:
        """Return the rows that did not pass."""
        return [row for row in self.rows if row.passed is False]


def load(name: str) -> Law:
    """Return an included law by its name, or the law LAW of a Python file by the name FILE.py:LAW.

    If LAW is a class, its parameters get their typical values.

    Raises:
        InputError: the law or file does not exist or does not work, or a parameter has no typical value.
    """
    if ":" not in name and not name.endswith(".py"):
        return laws.typical(name)
    file, _, attribute = name.rpartition(":") if ":" in name else (name, "", "")
    if not Path(file).is_file():
        raise InputError(f"{file} is not a file: give FILE.py:LAW with the path of a Python file")
    # `dataclasses` needs the module in `sys.modules`. The name of the module there differs from the file name, since
    # the file may be named jax.py, for example.
    spec = importlib.util.spec_from_file_location(f"_law_file_{Path(file).stem}", file)
    if spec is None:
        raise InputError(f"{file} is not a Python file: give FILE.py:LAW")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(Path(file).resolve().parent))
    try:
        loader: Any = spec.loader
        loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f"{file} does not run ({_reason(error)}): correct this file first") from None
    finally:
        sys.path.pop(0)
    found: Any = getattr(module, attribute, None) if attribute else None
    if found is None:
        own = {n: v if inspect.isclass(v) else type(v) for n, v in vars(module).items() if _is_law(v)}
        offered = [n for n, c in own.items() if c.__module__ == module.__name__ or not inspect.isclass(vars(module)[n])]
        wrong = f"{file} has no {attribute}" if attribute else f"{name} names a file, but not a law in this file"
        raise InputError(
            f"{wrong}: {'use ' + ' or '.join(f'{file}:{n}' for n in offered) if offered else 'define a law'}"
        )
    if not _is_law(found):
        raise InputError(
            f"{name} is not a law: derive its class from liverjax.Law and decorate the class with liverjax.struct"
        )
    law = _typical_law(found, name) if inspect.isclass(found) else found
    _try(law, name)
    _try_parts(law, name)
    return law


def _reason(error: BaseException) -> str:
    """Return kind and message of an exception in one line of at most 150 characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:150]


def _try(law: Law, name: str) -> None:
    """Check the shapes of energy, stress and tangent of the law. Every error is raised as `InputError`."""
    if getattr(law, "bulk", None) is not None and not hasattr(law, "volumetric"):
        raise InputError(
            f"{name}: the law has a field bulk, but no field volumetric: add volumetric: str = lj.static('quadratic')"
        )
    for shape in ((), (2,)):
        F = jnp.broadcast_to(jnp.diag(jnp.array([1.1, 0.9, 1.05])), (*shape, 3, 3))
        for what, expected in (("energy", shape), ("first_piola", (*shape, 3, 3)), ("tangent", (*shape, 3, 3, 3, 3))):
            try:
                found = jax.eval_shape(lambda law, F, what=what: getattr(law, what)(F), law, F).shape
            except Exception as error:
                raise InputError(
                    f"{name}: its {what} cannot be evaluated ({_reason(error)}); correct the law. List all invariants "
                    "of its energy in `invariants`, give a single fibre direction, and write conditions on parameters "
                    "with jnp.where"
                ) from None
            if found != expected:
                raise InputError(
                    f"{name}: for F of shape {F.shape}, its {what} has shape {found}, not {expected}; correct the law"
                )


def _try_parts(law: Law, name: str) -> None:
    """Check that the isochoric and volumetric energies can be evaluated. Every error is raised as `InputError`."""
    for what in ("isochoric_part", "volumetric_part"):
        try:
            part = getattr(law, what)()
            if part is not None:
                jax.eval_shape(part.energy, jnp.eye(3))
        except Exception as error:
            raise InputError(
                f"{name}: its {what} cannot be evaluated ({_reason(error)}): if the law has a field bulk, add a field "
                "volumetric (volumetric: str = lj.static('quadratic')). A law that overrides strain_energy must work "
                "with bulk = None, or define isochoric_part and volumetric_part"
            ) from None


def _is_law(value: object) -> bool:
    return isinstance(value, Law) or (inspect.isclass(value) and issubclass(value, Law) and value is not Law)


def _typical_law(cls: type, name: str) -> Law:
    if "__dataclass_fields__" not in vars(cls):
        raise InputError(f"{name} is not decorated: write @liverjax.struct above its class")
    values = {f.name: f.metadata.get("typical") for f in laws.parameters(cls)}
    missing = [n for n, v in values.items() if v is None]
    if missing:
        raise InputError(
            f"{name}: parameter {missing[0]} has no typical value; write param(…, typical=…) in the class, or name an "
            "object of this class instead of the class (FILE.py:OBJECT)"
        )
    try:
        return cls(**values)
    except TypeError as error:
        raise InputError(
            f"no object of {name} can be made ({_reason(error)}): give every field a typical value or a default"
        ) from None


def check(law: Law) -> Check:
    """Run all checks of a law, and return their rows. A wrong law raises no error: some rows have `passed` = False."""
    programs = [jax.jit(lambda law, F, what=what: getattr(law, what)(F)) for what in _PROGRAMS]
    energy, stress, tangent = (partial(program, law) for program in programs)
    more, stable = stability_rows(law, tangent)
    more += jump_rows(energy, stress, tangent)
    F, D, first = _finite_samples((energy, stress, tangent))
    rows, errors = [first], {}
    W, P, A = (as_numbers(f, F) for f in (energy, stress, tangent))
    slope, curved = np.einsum("nij,nij->n", P, D), np.einsum("nijkl,nkl->nij", A, D)
    for name, function, exact in (("energy to stress", energy, slope), ("stress to tangent", stress, curved)):
        errors[name] = np.array([_difference(function, F, D, h, exact) for h in STEPS])
        rows.append(_v_shape(name, errors[name]))
    rows += _derivative_rows(law, F, stable["uniaxial"], programs[1:])
    Q = _rotation(4)
    size = np.abs(W).max() + np.abs(P).max()
    rows.append(_exact("objective: W(QF) = W(F)", as_numbers(energy, Q @ F), W, size))
    rows.append(_exact("objective: P(QF) = Q P(F)", as_numbers(stress, Q @ F), Q @ P))
    rows.append(_exact("tangent symmetric", A, np.transpose(A, (0, 3, 4, 1, 2))))
    rows += _rest_state(law, energy, stress, tangent)
    rows += _limits_of_energy(energy)
    rows += _parts_rows(law, F, W, size) + _idle_parameters_row(law, programs[:2], F)
    return Check(law, rows + more, STEPS, errors, stable)


def _finite_samples(functions: Sequence[Callable]) -> tuple[np.ndarray, np.ndarray, Row]:
    """Return deformation gradients, directions, and a row with their range of stretches.

    The stretches lie in `_MODERATE`. If energy, stress or tangent is not finite there, the stretches lie in the widest
    range of `_NARROWER` in which all three are finite. If there is no such range, the row fails.
    """
    for low, high in (_MODERATE, *_NARROWER):
        F, D = _samples(low, high)
        if all(np.isfinite(as_numbers(f, F)).all() for f in functions):
            break
    else:
        return *_samples(), Row("finite at moderate stretches", "NaN or infinite", "0.7 to 1.4", False)
    if (low, high) == _MODERATE:
        return F, D, Row("finite at moderate stretches", "yes", "0.7 to 1.4", True)
    return (
        F,
        D,
        Row(
            "finite at moderate stretches",
            f"only from {low:g} to {high:g}",
            "does the law have a limiting stretch?",
            None,
        ),
    )


def _derivative_rows(law: Law, F: np.ndarray, stable: tuple[float, float], programs: Sequence[Callable]) -> list[Row]:
    """Return two rows that compare stress and tangent with automatic differentiation.

    Each row summarises three comparisons: at moderate stretches, over the stable range, and with changed parameters
    that are not 0. The row shows the first comparison that fails. If none fails, it shows the first comparison.
    """
    low, high = max(stable[0], 0.5), min(stable[1], 2.0)
    sets = [("", law, F)]
    if low < high:  # otherwise only the rest state is stable, and its stress is only roundoff
        sets.append((f", stretches {low:.2g} to {high:.2g}", law, _samples(low, high)[0]))
    sets.append((", parameters times 0.8 (0: 0.1)", _with_other_parameters(law), F))
    rows = []
    oracles = (autodiff.first_piola, autodiff.tangent)
    for name, program, oracle in zip(("stress", "tangent"), programs, oracles, strict=True):
        exact, found = jax.jit(oracle), []
        for where, own, at in sets:
            ours, theirs = (as_numbers(partial(f, own), at).reshape(len(at), -1) for f in (program, exact))
            # A law may have a limiting stretch. So values that are not finite are ignored, except in the first set.
            known = (np.isfinite(ours) & np.isfinite(theirs)).all(axis=1) | (where == "")
            if np.any(known):
                found.append(_exact(f"{name} by hand against autodiff{where}", ours[known], theirs[known]))
        rows.append(next((row for row in found if not row.passed), found[0]))
    return rows


def _with_other_parameters(law: Law) -> Law:
    """Return the law with changed parameters. None of the changed parameters is 0."""
    return jax.tree.map(lambda v: jnp.where(jnp.asarray(v) == 0, 0.1, 0.8 * jnp.asarray(v)), law)


def _parts_rows(law: Law, F: np.ndarray, W: np.ndarray, size: float) -> list[Row]:
    """Check that the energy is the sum of its isochoric and volumetric parts. Viscosity may use these parts.

    Two more rows are returned only if they fail: the isochoric part must not change with the volume, and the volumetric
    part must not change with the shape.
    """
    isochoric, volumetric = law.isochoric_part(), law.volumetric_part()
    if isochoric is None or volumetric is None:
        return []
    of_shape, of_volume = jax.jit(isochoric.energy), jax.jit(volumetric.energy)
    both = as_numbers(of_shape, F) + as_numbers(of_volume, F)
    swollen, round_ones = 1.1 * F, np.cbrt(np.linalg.det(F))[:, None, None] * np.eye(3)
    alone = [
        _exact(
            "the isochoric part depends on the volume", as_numbers(of_shape, swollen), as_numbers(of_shape, F), size
        ),
        _exact(
            "the volumetric part depends on the shape",
            as_numbers(of_volume, round_ones),
            as_numbers(of_volume, F),
            size,
        ),
    ]
    return [_exact("energy is that of its parts", both, W, size), *(row for row in alone if not row.passed)]


def _idle_parameters_row(law: Law, programs: Sequence[Callable], F: np.ndarray) -> list[Row]:
    """Return a row with the parameters that change neither energy nor stress, or no row if there are none."""
    law = _with_other_parameters(law)
    leaves, structure = jax.tree_util.tree_flatten_with_path(law)
    before, idle = [as_numbers(partial(f, law), F) for f in programs], []
    for k, (path, value) in enumerate(leaves):
        values = [v for _, v in leaves]
        values[k] = 1.25 * value
        other = jax.tree.unflatten(structure, values)
        if all(np.array_equal(as_numbers(partial(f, other), F), b) for f, b in zip(programs, before, strict=True)):
            idle.append(jax.tree_util.keystr(path).lstrip("."))
    return [Row("parameters without effect", ", ".join(idle), "is the energy complete?", False)] if idle else []


#: Methods of a law that are checked. Each method is compiled once for all values of the parameters.
_PROGRAMS = ("energy", "first_piola", "tangent")


#: To find a jump of the stiffness at rest, the stiffness is computed for small strains of size `NEAR`. If there is no
#: jump, the relative change of the stiffness is less than `JUMP`.
NEAR, JUMP = 1e-7, 1e-4


def _rotation(seed: int) -> np.ndarray:
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))


def _samples(low: float = _MODERATE[0], high: float = _MODERATE[1]) -> tuple[np.ndarray, np.ndarray]:
    """Return 12 deformation gradients with stretches between `low` and `high`, and 12 directions in which F changes."""
    rng = np.random.default_rng(2)
    stretches = rng.uniform(low, high, (12, 3))
    stretches[:3, 1] = stretches[:3, 0]  # some samples have two equal stretches
    F = np.stack([_rotation(k) @ np.diag(s) @ _rotation(k + 100) for k, s in enumerate(stretches)])
    D = rng.standard_normal((12, 3, 3))
    return F, D / np.linalg.norm(D, axis=(1, 2))[:, None, None]


def _difference(function: Callable, F: np.ndarray, D: np.ndarray, h: float, exact: np.ndarray) -> float:
    """Return the maximum difference between the central difference of `function` in the direction D, with step h, and
    the derivative `exact`, divided by the maximum of |exact|."""
    quotient = (as_numbers(function, F + h * D) - as_numbers(function, F - h * D)) / (2 * h)
    return float(np.abs(quotient - exact).max() / max(np.abs(exact).max(), 1e-300))


def _v_shape(name: str, errors: np.ndarray) -> Row:
    limit = f"< {DIFFERENCE_LIMIT:.0e}"
    if not np.isfinite(errors).any():
        return Row(f"{name}, differences", "not finite", limit, False)
    k = int(np.nanargmin(errors))
    if errors[k] == 0:
        return Row(f"{name}, differences", "exact", limit, True)
    order = np.log10(errors[1] / errors[4]) / np.log10(STEPS[1] / STEPS[4])
    found = f"fall as h^{order:.1f} to {errors[k]:.1e} at step {STEPS[k]:.0e}"
    return Row(f"{name}, differences", found, limit, bool(errors[k] < DIFFERENCE_LIMIT))


def _exact(name: str, ours: np.ndarray, theirs: np.ndarray, size: float | None = None) -> Row:
    scale = np.abs(theirs).max() if size is None else size
    error = float(np.abs(ours - theirs).max() / scale) if scale > 0 else float(np.abs(ours).max())
    return Row(name, f"{error:.1e}", f"< {EXACT_LIMIT:.0e}", bool(error < EXACT_LIMIT))


def _rest_state(law: Law, energy: Callable, stress: Callable, tangent: Callable) -> list[Row]:
    """Return rows about energy, stress and moduli of the undeformed state.

    The moduli are Voigt means. For an isotropic law, each mean is the modulus in every direction.
    """
    W, P, A = (as_numbers(f, np.tile(np.eye(3), (len(_samples()[0]), 1, 1)))[0] for f in (energy, stress, tangent))
    if not np.isfinite(A).all():
        return [Row("tangent at rest", "not finite", "finite", False)]
    scale = np.abs(A).max()
    rows = []
    for name, value in (("energy at rest", np.abs(W)), ("stress at rest", np.abs(P).max())):
        # If a law has no stiffness at rest (for example slack fibres), the value is compared with 1 Pa.
        error = value / (scale if scale > 0 else 1.0)
        found = f"{error:.1e} of the tangent" if scale > 0 else f"{value:.1e} Pa"
        rows.append(Row(name, found, f"< {EXACT_LIMIT:.0e}", bool(error < EXACT_LIMIT)))
    smallest = _smallest_stiffness(A)
    if smallest < -EXACT_LIMIT * scale:
        rows.append(Row("stiffness at rest", f"{smallest:.6g} Pa for a strain", "not negative", False))
    moduli, near = _mean_moduli(A[None])[:, 0], _mean_moduli(as_numbers(tangent, _near_rest()))
    jumps = np.ptp(near, axis=1).max() > JUMP * np.abs(near).max()
    if jumps:
        rows.append(Row("stiffness at rest jumps", "depends on the direction", "fibres that go slack?", None))
    names = (("shear modulus", "shear_modulus"), ("bulk modulus", "bulk_modulus"))
    for (name, method), value, around in zip(names, moduli, near, strict=True):
        low, high = (around.min(), around.max()) if jumps else (value, value)
        found = f"{low:.6g} to {high:.6g} Pa" if jumps else f"{value:.6g} Pa"
        try:
            stated = float(getattr(law, method)())
        except Exception:  # the law does not define the method, or the method fails
            rows.append(Row(f"ground-state {name}", found, "not stated", None))
            continue
        allowed = (JUMP if jumps else 1e-9) * np.abs(moduli).sum()
        agrees = bool(low - allowed < stated < high + allowed)
        rows.append(Row(f"ground-state {name}", found, f"stated {stated:.6g}", agrees))
    return rows


def _smallest_stiffness(A: np.ndarray) -> float:
    """Return the smallest eigenvalue [Pa] of the tangent A (3, 3, 3, 3) at rest, for symmetric strains. If it is
    negative, the energy is not a minimum at rest."""
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    strains = np.zeros((6, 3, 3))
    for own, (i, j) in zip(strains, pairs, strict=True):
        own[i, j] = own[j, i] = 1.0 if i == j else np.sqrt(0.5)
    return float(np.linalg.eigvalsh(np.einsum("aij,ijkl,bkl->ab", strains, A, strains)).min())


def _mean_moduli(A: np.ndarray) -> np.ndarray:
    """Return the Voigt means of shear and bulk modulus (2, n) [Pa], from tangents (n, 3, 3, 3, 3)."""
    normal, coupled = np.einsum("niiii->n", A), A[:, 0, 0, 1, 1] + A[:, 0, 0, 2, 2] + A[:, 1, 1, 2, 2]
    sheared = A[:, 0, 1, 0, 1] + A[:, 0, 2, 0, 2] + A[:, 1, 2, 1, 2]
    return np.stack([(normal - coupled) / 15 + sheared / 5, (normal + 2 * coupled) / 9])


def _near_rest() -> np.ndarray:
    """Return n deformation gradients (n, 3, 3) with very small strains, in pairs of opposite strains."""
    D = _samples()[1]
    D = np.concatenate([np.eye(3)[None], D + np.transpose(D, (0, 2, 1))])
    return np.eye(3) + NEAR * np.concatenate([D, -D])


def _limits_of_energy(energy: Callable) -> list[Row]:
    """Return rows about the energy for J -> 0, J -> infinity, J = 0 and J < 0."""

    def along(*sizes: float) -> np.ndarray:
        return as_numbers(energy, np.stack([s ** (1 / 3) * np.eye(3) for s in sizes]))

    small, large = along(1e-4, 1e-8, 1e-16), along(1e4, 1e8)
    if not np.isfinite(small).all():
        crushed = "not finite"
    elif small[2] > 1.5 * small[1]:
        crushed = "grows without bound"
    else:
        crushed = f"finite ({small[2]:.3g} Pa): nothing stops an element from being crushed flat"
    grows = "not finite" if not np.isfinite(large).all() else "faster" if large[1] > 1e4 * large[0] else "no faster"
    swollen = grows if grows == "not finite" else f"grows {grows} than J"
    flat, inverted = np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 1.0, -0.5])
    ends = ["finite" if np.isfinite(as_numbers(energy, F)).all() else "not finite" for F in (flat, inverted)]
    return [
        Row("energy as J -> 0", crushed, "", None),
        Row("energy as J -> infinity", swollen, "", None),
        Row("energy at J = 0, J < 0", f"{ends[0]}, {ends[1]}", "", None),
    ]


def table(result: Check) -> str:
    """Return the table as a string: the first line of the law's docstring, then the rows."""
    width = max(len(row.name) for row in result.rows)
    mark = {True: "ok", False: "FAILED", None: ""}
    lines = [(type(result.law).__doc__ or type(result.law).__name__).strip().splitlines()[0]]
    for row in result.rows:
        limit = f"   ({row.limit})" if row.limit else ""
        lines.append(f"{row.name:{width}s}  {mark[row.passed]:6s}  {row.found}{limit}")
    return "\n".join(lines)
