"""Make the tables of data/: ``python -m experiments.sources.make_data FOLDER``.

FOLDER contains the folders lions_mane and curves. Without FOLDER, only the tables that follow from the chapter are
written.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fitting.methods.generalised_maxwell import Maxwell, moduli

DATA = Path(__file__).parents[2] / "data"

LION = """\
# Storage and loss moduli of lion's mane mushroom "steak" (Hericium erinaceus), a soft fibrous tissue, in oscillatory
# torsion.
# Mean and standard deviation (n - 1) over ten in-plane samples at each of 31 angular frequencies.
# Instrument: TA Instruments DHR, 8 mm parallel plates (radius 4 mm), mean gap {gap:.1f} mm, 25 C, rim strain 1.9-2 %
# (raw angle times radius over gap, which agrees with raw torque and G').
# Source: raw sweeps of the Living Matter Lab, repository CANN, folder ARTMEAT/LionsManeMushroomSteak/Rheology
# (doi 10.64898/2026.01.19.700477); this table was computed from them by experiments/sources/make_data.py.
# Units: rad/s and Pa. Above about 30 rad/s the instrument's inertia begins to show.
angular_frequency_rad_s,storage_modulus_Pa,storage_modulus_sd_Pa,loss_modulus_Pa,loss_modulus_sd_Pa
"""

PORCINE = """\
# MODEL-IMPLIED, not measured: storage and loss moduli of porcine liver that data/porcine_liver_prony.toml
# implies at 16 frequencies, log-spaced from 0.1 to 4 Hz. The measured points exist in print only as a picture.
# Source: Marchesseau, Chatelin, Delingette 2017 (HAL hal-01536406), Table 2 and the generalised Maxwell model of its
# section 5.2; computed by experiments/sources/make_data.py. Units: Hz and Pa.
frequency_Hz,storage_modulus_Pa,loss_modulus_Pa
"""

RUBBER = """\
# Nominal stress of vulcanised rubber (8 % sulphur) in uniaxial tension, equibiaxial tension and pure shear.
# Source: Treloar 1944, Trans. Faraday Soc. 40, 59-70, as digitised in the repository
# Chongran-Zhao/Calibration-Hyperelasticity (MIT licence); tabulated by experiments/sources/make_data.py.
# Units: stretch 1, stress MPa.
test,stretch,nominal_stress_MPa
"""

BRAIN = """\
# Nominal stress of human brain cortex in tension, compression and simple shear (quasi-static, first loading).
# Source: Budday et al. 2017, Acta Biomaterialia 48, 319-340, as digitised in the repository
# Chongran-Zhao/Calibration-Hyperelasticity (MIT licence); every second point, tabulated by make_data.py.
# Units: stretch and shear 1, stress kPa.
test,stretch,shear,nominal_stress_kPa
"""

#: Table 2 (the values g are ratios, not Pa as printed).
TABLE_2 = Maxwell(jnp.array(770.0), jnp.array([0.235, 0.333]), jnp.array([0.27, 0.03]))


def lions_mane(folder: Path) -> None:
    """Write mean and standard deviation of the raw sweeps."""
    files = sorted(folder.glob("lion-frequency-inplane-*.csv"))
    raw = np.stack([np.loadtxt(f, delimiter=",", skiprows=2) for f in files])
    gaps = [float(f.open().readline().split("preload ")[1].split(" um")[0]) for f in files]
    mean, sd = raw.mean(axis=0), raw.std(axis=0, ddof=1)
    with (DATA / "lions_mane_frequency_sweep.csv").open("w") as out:
        out.write(LION.format(gap=np.mean(gaps) / 1000))
        for m, s in zip(mean, sd, strict=True):
            out.write(",".join(f"{v:.6g}" for v in (m[0], m[1], s[1], m[2], s[2])) + "\n")


def porcine_liver() -> None:
    """Write the moduli that follow from Table 2, with all digits."""
    f = np.geomspace(0.1, 4.0, 16)
    storage, loss = moduli(TABLE_2, jnp.asarray(2 * np.pi * f))
    with (DATA / "porcine_liver_frequency_sweep.csv").open("w") as out:
        out.write(PORCINE)
        for row in zip(f, storage, loss, strict=True):
            out.write(",".join(f"{float(v):.17g}" for v in row) + "\n")


def rubber(folder: Path) -> None:
    """Write all points of Treloar's three tests."""
    with (DATA / "rubber_curves.csv").open("w") as out:
        out.write(RUBBER)
        for letters, test in (("UT", "uniaxial"), ("ET", "equibiaxial"), ("PS", "pure_shear")):
            for row in np.genfromtxt(folder / f"Treloar_1944__{letters}.csv", delimiter=",", names=True):
                out.write(f"{test},{row['F11']:.5g},{row['P11']:.5g}\n")


def brain(folder: Path) -> None:
    """Write every second point of the tests on one region."""
    with (DATA / "brain_cortex_curves.csv").open("w") as out:
        out.write(BRAIN)
        for letters in ("UT_T", "UT_C"):
            for row in np.genfromtxt(folder / f"Budday_2017__{letters}_cortex.csv", delimiter=",", names=True)[::2]:
                out.write(f"uniaxial,{row['F11']:.5g},,{row['P11']:.5g}\n")
        for row in np.genfromtxt(folder / "Budday_2017__SS_cortex.csv", delimiter=",", names=True)[::2]:
            out.write(f"simple_shear,1,{row['F12']:.5g},{row['P12']:.5g}\n")


if __name__ == "__main__":
    porcine_liver()
    if len(sys.argv) > 1:
        lions_mane(Path(sys.argv[1]) / "lions_mane")
        rubber(Path(sys.argv[1]) / "curves")
        brain(Path(sys.argv[1]) / "curves")
