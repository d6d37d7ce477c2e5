"""Units that may occur in files, and the factors that convert them to SI (frequencies to rad/s)."""

import numpy as np

#: mPa is excluded, because it means millipascal but is also a common misspelling of MPa (a factor of 1e9).
MODULUS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9} | {"pa": 1.0, "kpa": 1e3, "gpa": 1e9, "MPA": 1e6}
MODULUS_UNITS |= {"PA": 1.0, "KPA": 1e3}
MODULUS_UNITS |= dict.fromkeys(("N/m2", "N/m²", "N/m^2"), 1.0) | {"N/mm2": 1e6, "N/mm²": 1e6, "N/mm^2": 1e6}
MODULUS_UNITS |= {"psi": 6894.757293168, "ksi": 6894757.293168}
MODULUS_UNITS |= dict.fromkeys(("dyn/cm2", "dyn/cm²", "dyn/cm^2", "dyne/cm2", "dyne/cm²", "dyne/cm^2"), 0.1)
#: Units in `PER_SECOND` may mean Hz or rad/s, so they are accepted only if the heading names an angular frequency.
PER_SECOND = ("1/s", "s-1", "s^-1", "s⁻¹")
FREQUENCY_UNITS = {"hz": 2 * np.pi, "khz": 2e3 * np.pi} | dict.fromkeys(("rad/s", "rad/sec", "rad_s", *PER_SECOND), 1.0)
FREQUENCY_UNITS |= dict.fromkeys(("rad s-1", "rad_s-1", "rad s^-1", "rad·s-1", "rad.s-1", "rad*s-1"), 1.0)
FREQUENCY_UNITS |= dict.fromkeys(("rad s⁻¹", "rad·s⁻¹", "rad/sek"), 1.0)
ANGLE_UNITS = dict.fromkeys(("°", "º", "deg", "degree", "degrees", "grad"), np.pi / 180) | {"rad": 1.0, "mrad": 1e-3}
TANGENT_UNITS = dict.fromkeys(("", "-", "1", "none"), 1.0)
VISCOSITY_UNITS = {
    f"{unit}{sign}s": factor for unit, factor in (("Pa", 1.0), ("mPa", 1e-3), ("kPa", 1e3)) for sign in " .·*_-"
}
#: Units of the stress in stress-stretch curves.
STRESS_UNITS = {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6}
_TORQUE = {"N.m": 1.0, "Nm": 1.0, "mN.m": 1e-3, "mNm": 1e-3, "uN.m": 1e-6, "uNm": 1e-6, "nN.m": 1e-9, "nNm": 1e-9}
#: Units of columns that an instrument writes in addition to the moduli.
RAW_TORQUE_UNITS = {
    "torque": _TORQUE,
    "sample_torque": _TORQUE,
    "angle": ANGLE_UNITS | {"urad": 1e-6},
    "phase": ANGLE_UNITS,
    "strain": {"%": 0.01, "percent": 0.01, "1": 1.0, "-": 1.0, "mm/mm": 1.0, "": 1.0},
}
_PER_PA = {f"1/{unit}": 1 / factor for unit, factor in MODULUS_UNITS.items()} | {"Pa-1": 1.0, "Pa^-1": 1.0}
#: Units of relaxation and creep tests; the first unit of each quantity is the default.
TIME_TEST_UNITS = {
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "ms": 1e-3, "us": 1e-6}
    | {"sec": 1.0, "seconds": 1.0, "minutes": 60.0, "hr": 3600.0, "hours": 3600.0},
    "modulus": {"Pa": 1.0} | MODULUS_UNITS,
    "tensile modulus": {"Pa": 1.0} | MODULUS_UNITS,
    "compliance": {"1/Pa": 1.0} | _PER_PA,
    "tensile compliance": {"1/Pa": 1.0} | _PER_PA,
    "strain": {"1": 1.0, "%": 1e-2, "-": 1.0, "mm/mm": 1.0},
    "stress": {"Pa": 1.0} | MODULUS_UNITS,
    "tensile strain": {"1": 1.0, "%": 1e-2, "-": 1.0, "mm/mm": 1.0},
    "tensile stress": {"Pa": 1.0} | MODULUS_UNITS,
    "torque": _TORQUE,
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "°": np.pi / 180},
    "force": {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "kN": 1e3}
    | {"g": 9.80665e-3, "gf": 9.80665e-3, "kgf": 9.80665},
    "displacement": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "cm": 1e-2},
}
#: Units of indentation curves.
INDENTATION_UNITS = {
    "depth": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9},
    "force": {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "µN": 1e-6, "μN": 1e-6, "nN": 1e-9, "pN": 1e-12},
}
#: Units of shear waves; the first unit of each quantity is the default. 1 Np (neper) is a factor of e in amplitude.
WAVE_UNITS = {
    "frequency": {"Hz": 2 * np.pi, "kHz": 2e3 * np.pi, "rad/s": 1.0, "rad_s": 1.0},
    "velocity": {"m/s": 1.0, "m_s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "attenuation": {"1/m": 1.0, "Np/m": 1.0, "1/cm": 1e2, "Np/cm": 1e2, "1/mm": 1e3}
    | {"dB/m": np.log(10) / 20, "dB/cm": 5 * np.log(10)},
}


def celsius(kelvin: float | np.ndarray) -> np.ndarray:
    """Convert temperatures from K to °C. The result is rounded, which removes the roundoff of the subtraction."""
    return np.round(np.asarray(kelvin) - 273.15, 9)
