"""Torsion of a sample that the plates compress first (`--precompression`).

At rest, the sample has the radius of the plates; it is not trimmed after the compression. It stays compressed until its
stress has relaxed. Moduli in this file are the moduli that the instrument reports. The instrument computes these
moduli with the radius of the plates and the gap during the test.

If the sample can slide sideways on the plates, it stays a cylinder. The cylinder has the stretches a along the radius
and l along the axis, and the axial stress s. For an isotropic law, a shear between the axis and a lateral direction has
the modulus l^2 s / (l^2 - a^2) (Ericksen's relation; Rivlin 1949 for the incompressible cylinder). The part s of this
modulus comes from the axial prestress. The remaining part, a^2 s / (l^2 - a^2), comes from the material. The torque is
proportional to the fourth power of the radius. So the instrument reports

    G*(omega) = a^4 s [a^2 / (l^2 - a^2) (1 - sum_k g_k / (1 + i omega tau_k)) + (1 - sum_k g_k)]

where s is the axial stress before relaxation, and g_k and tau_k are the ratio and the relaxation time of mode k. So the
relaxing part and the equilibrium modulus have different factors.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import liverjax as lj
from fitting.rigs.plates import Rig
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.laws import Law

#: Maximum compression of a sample, as a fraction of its height.
LARGEST = 0.5
#: Maximum strain of one load step.
_STEP = 0.05
#: Lower ends of the interval that is searched for the radial stretch, divided by the smaller of 1 and the radial
#: stretch at constant volume. The second end is used if the first is too high, which happens if Poisson's ratio is
#: small.
_LOWER_ENDS = (0.9, 0.5)


class Shares(NamedTuple):
    """Reported moduli of a compressed cylinder that can slide sideways, divided by the moduli of the uncompressed
    sample [1]."""

    relaxing: float  # factor of the moduli of the modes
    equilibrium: float  # factor of the equilibrium modulus


def check_strain(strain: float) -> None:
    """Raise `InputError` if the compression is not between 0 and `LARGEST`."""
    if not 0 <= strain <= LARGEST:
        meant = f"{strain / 100:g}" if 1 <= strain <= 100 * LARGEST else "0.05"  # the value may be in percent
        raise InputError(
            f"--precompression {strain:g} is out of range: the compression is a fraction of the height, from 0 to "
            f"{LARGEST:g}; give e.g. --precompression {meant}"
        )


def shares(law: Law, strain: float) -> Shares:
    """Return the reported moduli, divided by the moduli of the uncompressed sample, for a sample that is compressed by
    `strain` between frictionless plates (formula at the top of this file).

    Raises:
        InputError: the law is not isotropic, or it does not resist the compression.
    """
    if strain == 0:
        return Shares(1.0, 1.0)
    a, axial = side_stretch(law, strain), 1 - strain
    s = float(_cauchy(law, a, axial)[2])
    G = float(np.asarray(law.shear_modulus()))
    if not (s < 0 and np.isfinite(s)):
        raise InputError(
            f"law {type(law).__name__} does not resist a compression by {strain:g}: give a smaller --precompression or "
            "another --law"
        )
    relaxing = a**6 * s / (axial**2 - a**2) / G
    return Shares(relaxing, relaxing + a**4 * s / G)


def incompressible(law: Law, strain: float) -> Shares | None:
    """Return the same factors as `shares`, but for an incompressible sample. The axial stress s is then computed
    without the volumetric energy U(J) of the law.

    Returns None if the law has no isochoric part, or if the strain is 0.
    """
    _refuse_directions(law)
    axial, own = 1 - strain, law.isochoric_part()
    if own is None or strain == 0:
        return None
    a = 1 / np.sqrt(axial)
    side, _, s = _cauchy(own, a, axial)
    s -= side  # this pressure makes the side free of stress
    G = float(np.asarray(law.shear_modulus()))
    relaxing = float(a**6 * s / (axial**2 - a**2) / G)
    return Shares(relaxing, relaxing + float(a**4 * s / G))


def side_stretch(law: Law, strain: float) -> float:
    """Return the radial stretch of a cylinder that is compressed by `strain` between frictionless plates. A negative
    strain is a tension.

    Raises:
        InputError: the law is not isotropic, or no radial stretch makes the side free of stress.
    """
    _refuse_directions(law)
    axial = 1 - strain
    for low in _LOWER_ENDS:
        ends = low * min(1.0, axial**-0.5), 1.1 * max(1.0, axial**-0.5)
        try:
            return float(brentq(lambda a: _cauchy(law, a, axial)[0], *ends, xtol=1e-14))
        except ValueError:  # the stress has the same sign at both ends
            continue
    raise InputError(
        f"the radial stretch of a sample with law {type(law).__name__} is not found at a compression by {strain:g}: "
        "give a smaller compression, or a larger Poisson's ratio"
    )


def torsional_density(law: Law, strain: float, density: float) -> float:
    """Return the density [kg/m^3] with which `fitting.fits.sample_inertia` gives the right inertia of a compressed
    sample. That module uses the gap and the moduli that the instrument reports.

    The compressed cylinder has the radius a R (R: radius of the plates), the density rho / (a^2 l) and a modulus G. The
    instrument reports a^4 G. The wave number omega sqrt(rho / (a^2 l G)) equals omega sqrt(rho a^2 / (l a^4 G)). So the
    density is rho a^2 / l.
    """
    return density if strain == 0 else density * side_stretch(law, strain) ** 2 / (1 - strain)


def smooth_force(law: Law, strain: float, radius: float) -> float:
    """Return the force [N] with which the sample pushes frictionless plates apart before relaxation. With a negative
    `strain` (tension), the force is negative too. `radius`: radius of the sample at rest [m]."""
    if strain == 0:
        return 0.0
    a = side_stretch(law, strain)
    return -np.pi * (a * radius) ** 2 * float(_cauchy(law, a, 1 - strain)[2])


def _cauchy(law: Law, side: float, axial: float) -> np.ndarray:
    """Return the principal Cauchy stresses (3,) [Pa] for the stretches `side`, `side` and `axial`."""
    F = np.array([side, side, axial])
    return np.diagonal(np.asarray(law.first_piola(jnp.diag(F)))) * F / np.prod(F)


def _refuse_directions(law: Law) -> None:
    turned = [np.asarray(law.first_piola(jnp.diag(jnp.roll(jnp.array([1.1, 0.9, 1.05]), k)))) for k in range(3)]
    principal = [np.roll(np.diagonal(P), -k) for k, P in enumerate(turned)]
    if not np.allclose(principal, principal[0], rtol=1e-8):
        raise InputError(
            f"--precompression needs an isotropic law, and {type(law).__name__} is not isotropic: choose another --law"
        )


def load_steps(strain: float) -> int:
    """Return the number of load steps of a compression."""
    return max(1, int(np.ceil(strain / _STEP)))


def too_far(strain: float) -> InputError:
    """Return the `InputError` for a compression at which the simulation with glued plates does not converge."""
    return InputError(
        f"--precompression {strain:g}: the simulation did not converge at this compression; give a smaller value, or "
        "use --method closed-form, which assumes frictionless plates"
    )


def compressed(rig: Rig, law: Law, strain: float, smooth: bool = False) -> Rig:
    """Return the rig with its sample compressed by `strain`, before the plate turns.

    Args:
        rig: rig of the uncompressed sample. The height of the returned rig is the gap after the compression.
        law: law of the sample.
        strain: compression, as a fraction of the height at rest.
        smooth: whether the sample slides sideways on the plates during the compression, so that it stays a cylinder.
            Otherwise, the sample is glued and bulges.

    Raises:
        InputError: the simulation does not converge at this compression, `strain` is out of range, the height of the
            rig is free, or (if `smooth`) the law is not isotropic.
    """
    check_strain(strain)
    if strain == 0:
        return rig
    if rig.free_height:
        raise InputError(
            f"free_height = True and a compression by {strain:g} exclude each other, because a plate without axial "
            "force does not hold the sample compressed: make the rig with free_height = False"
        )
    X = rig.mesh.points
    gap = rig.height * (1 - strain)
    if smooth:
        low, a = jnp.min(X[:, 2]), side_stretch(law, strain)
        held = X * jnp.array([[a, a, 1 - strain]]) + jnp.array([[0.0, 0.0, 1.0]]) * low * strain
        return replace(rig, held=held, height=gap)
    n = rig.mesh.number_of_nodes
    scene = lj.Scene(
        mesh=rig.mesh,
        law=law,
        fixed=(lj.Fixed(nodes=jnp.arange(rig.bottom)),),
        displaced=(lj.Displaced(nodes=jnp.arange(n - rig.top, n), by=jnp.array([0.0, 0.0, -strain * rig.height])),),
        solve=lj.Solve(steps=load_steps(strain), tolerance=1e-11),
    )
    result = lj.simulate(scene)
    if np.any(np.asarray(result.status) != 0):
        raise too_far(strain)
    return replace(rig, held=result.positions[-1], height=gap)
