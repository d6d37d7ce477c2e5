"""The current torsion fit, compared with a fit that differentiates the whole simulation on the finer mesh.

``python -m experiments torsion_speed [--quick]`` (10 minutes) writes results/torsion_speed.json. For both shipped
sweeps: the largest difference of a modulus at any frequency, and of a parameter in units of its standard error; compile
time and run time of both. For other plates: the difference between the two meshes. In addition, the error of the
Jacobian against strain.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import liverjax as lj
from experiments.common import ROOT, either, save, timed
from fitting.fits import simulated_rheometer, viscoelastic
from fitting.fits.simulated_rheometer import Simulation
from fitting.readers.rheometer import Sweep, read_sweep
from fitting.rigs import torsion

#: Plates [m]: radius and height of the two data sets, of a tall sample, and of a flat one.
PLATES = either(((0.010, 0.004), (0.004, 0.0092), (0.010, 0.041), (0.020, 0.001)), ((0.010, 0.004),))
STRAINS = either((1e-3, 1e-2), (1e-3,))


def largest_difference(a: torsion.Moduli, b: torsion.Moduli) -> float:
    """Return the largest relative difference of G' or G'' at any frequency."""
    pairs = ((a.storage, b.storage), (a.loss, b.loss))
    return float(max(np.max(np.abs(np.asarray(x) / np.asarray(y) - 1)) for x, y in pairs))


def simulated(sweep: Sweep, u: jax.Array, simulation: Simulation, rig: torsion.Rig, whole: bool) -> Any:
    """Return residuals, Jacobian and moduli at u, with run times. With `whole`, the derivative goes through the
    simulation.
    """
    law = lj.laws.typical(simulation.law)
    torque = torsion.torque_for_strain(rig, np.hypot(sweep.storage, sweep.loss), simulation.strain)
    measured, scales = np.concatenate([sweep.storage, sweep.loss]), np.concatenate(sweep.deviations)
    data = (rig, law, jnp.asarray(sweep.angular_frequency), torque, measured, scales)

    def derivative(u, data):
        def twice(u):
            r, m = simulated_rheometer.simulated_residuals(u, data, simulation)
            return r, (r, m)

        J, (r, m) = jax.jacfwd(twice, has_aux=True)(u)
        return r, J, m

    def linear(u, data):
        return simulated_rheometer.with_jacobian(u, data, simulation)

    return timed(derivative if whole else linear, u, data, rounds=3)


def fits(name: str) -> dict[str, Any]:
    """Compare both methods at the minimum of one data set."""
    sweep = read_sweep(ROOT / "data" / f"{name}_frequency_sweep.csv")
    dense = viscoelastic.generalised_maxwell.spectrum(sweep)
    closed = viscoelastic.choose_modes(sweep, dense)[0]
    found = simulated_rheometer.through_torsion(sweep, closed)
    u, simulation = jnp.asarray(found.solution.u), Simulation()
    fine, coarse = torsion.make_rig(), simulated_rheometer.rig_of(simulation)
    (_, J, m), now = simulated(sweep, u, simulation, coarse, whole=False)
    (r, J_whole, m_whole), before = simulated(sweep, u, simulation, fine, whole=True)
    # Gauss-Newton step from here with the complete derivatives, in standard errors of the parameters.
    step, *_ = np.linalg.lstsq(np.asarray(J_whole), -np.asarray(r), rcond=None)
    spread = found.uncertainty.noise * np.sqrt(np.diag(np.linalg.inv(np.asarray(J_whole).T @ np.asarray(J_whole))))
    size = np.linalg.norm(np.asarray(J_whole), axis=0)
    return {
        "nodes": [coarse.mesh.number_of_nodes, fine.mesh.number_of_nodes],
        "largest_difference_of_a_modulus": largest_difference(m, m_whole),
        "largest_difference_of_a_column": float(np.max(np.linalg.norm(np.asarray(J - J_whole), axis=0) / size)),
        "distance_to_the_minimum_in_standard_errors": float(np.max(np.abs(step) / spread)),
        "iterations": int(found.solution.iterations),
        "compile_s": [now.compile, before.compile],
        "evaluation_s": [now.run, before.run],
    }


def meshes(radius: float, height: float) -> dict[str, Any]:
    """Return the moduli of Table 2's liver on the coarse mesh and on the finer one."""
    sweep = read_sweep(ROOT / "data" / "porcine_liver_frequency_sweep.csv")
    law, prony = lj.laws.typical("neo_hookean"), lj.Prony(ratios=(0.235, 0.333), relaxation_times=(0.27, 0.03))
    cells = [torsion.linear_cell_for(radius, height), torsion.cell_size_for(radius, height)]
    rigs = [torsion.make_rig(radius, height, cell) for cell in cells]
    torque = torsion.torque_for_strain(rigs[0], np.hypot(sweep.storage, sweep.loss), 1e-3)
    coarse, fine = (torsion.moduli(rig, law, prony, sweep.angular_frequency, torque) for rig in rigs)
    return {
        "radius_m": radius,
        "height_m": height,
        "nodes": [rig.mesh.number_of_nodes for rig in rigs],
        "bias_of_the_mesh": [float(m.bias[0].real) for m in (coarse, fine)],
        "largest_difference_of_a_modulus": largest_difference(coarse, fine),
    }


def strains() -> list[dict[str, float]]:
    """Return the error of the linear rig's Jacobian, against that of the simulation on the same mesh."""
    sweep = read_sweep(ROOT / "data" / "porcine_liver_frequency_sweep.csv")
    u = jnp.asarray(viscoelastic.closed_form(sweep, 2).solution.u)
    rows = []
    for strain in STRAINS:
        simulation = Simulation(strain=strain)
        rig = simulated_rheometer.rig_of(simulation)
        (_, J, _), (_, J_whole, _) = (simulated(sweep, u, simulation, rig, whole)[0] for whole in (False, True))
        size = np.linalg.norm(np.asarray(J_whole), axis=0)
        error = float(np.max(np.linalg.norm(np.asarray(J - J_whole), axis=0) / size))
        rows.append({"strain": strain, "largest_error_of_a_column": error})
    return rows


def main() -> None:
    """Run all parts."""
    content = {name: fits(name) for name in either(("lions_mane", "porcine_liver"), ("porcine_liver",))}
    content |= {"meshes": [meshes(*plate) for plate in PLATES], "strains": strains()}
    for name, row in content.items():
        print(name, row)
    save("torsion_speed", content)


if __name__ == "__main__":
    main()
