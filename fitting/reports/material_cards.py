"""Write Prony modes as material cards for liverjax, FEBio, Abaqus, Ansys and SOFA, in SI units (m, kg, s, Pa).

All cards contain a neo-Hookean law. Its shear modulus is the instantaneous modulus G0; only the card for SOFA, which
has no Prony series, contains the equilibrium modulus. If the equilibrium modulus cannot be distinguished from zero (a
fluid), the card for SOFA contains G0. The whole stress relaxes, as in the simulations of liverjax with part = "all". A
shear test does not determine the bulk modulus. The bulk modulus is computed from Poisson's ratio `POISSON`.
"""

from pathlib import Path

import numpy as np

from fitting.fits.families.limits import equilibrium_of
from fitting.methods.generalised_maxwell import Maxwell
from liverjax.core.files import write_whole

#: Poisson's ratio of the elastic law: nearly incompressible.
POISSON = 0.49
#: Maximum number of terms in FEBio's viscoelastic material.
FEBIO_TERMS = 6
#: Largest sum of ratios in the cards for Abaqus and liverjax, where the sum must be below 1.
LARGEST_SUM = 1 - 1e-6
#: An equilibrium modulus below this many standard errors cannot be distinguished from zero.
_DISTINCT = 2.0


def write(folder: Path, model: Maxwell, equilibrium_error: float = 0.0) -> list[str]:
    """Write all cards into `folder`. Return notes on every property that one of the programs cannot represent.
    `equilibrium_error`: standard error [Pa] of the equilibrium modulus; infinite if this modulus may be zero."""
    folder.mkdir(parents=True, exist_ok=True)
    told = []
    if len(model.ratios) > FEBIO_TERMS:
        told.append(
            f"FEBio has at most {FEBIO_TERMS} modes, but the model has {len(model.ratios)}, so no FEBio card is written"
        )
        (folder / "febio.feb").unlink(missing_ok=True)
    else:
        write_whole(folder / "febio.feb", febio(model))
    if np.sum(model.ratios) > LARGEST_SUM:
        told.append(
            "the model is a fluid, but Abaqus and liverjax need an equilibrium modulus: in the cards for these "
            "programs, a millionth of G0 does not relax"
        )
    for name, card in (
        ("liverjax.toml", scene_tables),
        ("abaqus.inp", abaqus),
        ("ansys.inp", ansys),
    ):
        write_whole(folder / name, card(model))
    write_whole(folder / "sofa.xml", sofa(model, equilibrium_error))
    if not _is_solid(model, equilibrium_error):
        told.append(
            f"the model is a fluid within the error of the fit (equilibrium modulus {equilibrium_of(model):.3g} Pa): "
            f"the card for SOFA contains G0 = {float(model.shear_modulus):.4g} Pa, and its stress does not relax"
        )
    return told


def _is_solid(model: Maxwell, equilibrium_error: float) -> bool:
    """Return whether the equilibrium modulus can be distinguished from zero. `equilibrium_error`: its standard error
    [Pa]."""
    smallest = (1 - LARGEST_SUM) * float(model.shear_modulus)
    return equilibrium_of(model) > max(smallest, _DISTINCT * equilibrium_error)


def _span(model: Maxwell) -> str:
    """Return a sentence on the relaxation that a card does not contain."""
    times = np.asarray(model.relaxation_times)
    return f"Modes of {times.min():.3g} to {times.max():.3g} s: faster and slower relaxation is not in this card."


def _bulk(shear: float) -> float:
    return 2 * shear * (1 + POISSON) / (3 * (1 - 2 * POISSON))


def _written_number(value: float) -> str:
    return f"{float(value):.10g}"


def _below_one(ratios: np.ndarray) -> np.ndarray:
    """Return the ratios. If their sum exceeds `LARGEST_SUM` (a fluid), they are reduced to this sum, so that a
    millionth of G0 does not relax."""
    return np.asarray(ratios) * min(1.0, LARGEST_SUM / max(float(np.sum(ratios)), 1e-300))


def scene_tables(model: Maxwell) -> str:
    """Return tables for a scene file of liverjax: the law with G0, and the viscosity."""
    G0, ratios, times = model
    return "\n".join(
        [
            "# SI units: Pa, s. Copy both tables into a scene file.",
            f"# {_span(model)}",
            f"# A shear test does not determine bulk: Poisson's ratio is {POISSON} here.",
            "[law]",
            'name = "neo_hookean"',
            f"mu = {_written_number(float(G0))}",
            f"bulk = {_written_number(_bulk(float(G0)))}",
            "",
            "[viscosity]",
            f"ratios = [{', '.join(map(_written_number, _below_one(ratios)))}]",
            f"relaxation_times = [{', '.join(map(_written_number, times))}]",
            "",
        ]
    )


def febio(model: Maxwell) -> str:
    """Return a viscoelastic material for FEBio. In FEBio, g0 is the fraction of the stress that does not relax, so the
    elastic law is the instantaneous law."""
    G0, ratios, times = model
    young = _written_number(2 * (1 + POISSON) * float(G0))
    terms = [f"      <t{k}>{_written_number(t)}</t{k}>" for k, t in enumerate(times, 1)]
    terms += [f"      <g{k}>{_written_number(g)}</g{k}>" for k, g in enumerate(ratios, 1)]
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f"<!-- SI units: Pa, s. Set the density of your tissue. {_span(model)} -->",
            '<febio_spec version="4.0">',
            "  <Material>",
            '    <material id="1" name="tissue" type="viscoelastic">',
            f"      <g0>{_written_number(max(0.0, 1 - float(np.sum(ratios))))}</g0>",
            *terms,
            '      <elastic type="neo-Hookean">',
            f"        <E>{young}</E>",
            f"        <v>{POISSON}</v>",
            "      </elastic>",
            "    </material>",
            "  </Material>",
            "</febio_spec>",
            "",
        ]
    )


def abaqus(model: Maxwell) -> str:
    """Return a hyperelastic material for Abaqus with instantaneous moduli, C10 = G0 / 2 and D1 = 2 / K (K: bulk
    modulus). Each mode has a line with shear ratio g, bulk ratio k and relaxation time tau."""
    G0, ratios, times = model
    kept = zip(_below_one(ratios), times, strict=True)
    rows = [f"{_written_number(g)}, {_written_number(g)}, {_written_number(t)}" for g, t in kept]
    return "\n".join(
        [
            "** SI units: Pa, s. Add *DENSITY.",
            f"** {_span(model)}",
            "*MATERIAL, NAME=TISSUE",
            "*HYPERELASTIC, NEO HOOKE, MODULI=INSTANTANEOUS",
            f"{_written_number(float(G0) / 2)}, {_written_number(2 / _bulk(float(G0)))}",
            "*VISCOELASTIC, TIME=PRONY",
            *rows,
            "",
        ]
    )


def ansys(model: Maxwell) -> str:
    """Return commands of Ansys Mechanical APDL: a neo-Hookean law with mu = G0 and d = 2 / K (K: bulk modulus). Shear
    and bulk have the same pairs of ratio and relaxation time, with six values per line."""
    G0, ratios, times = model
    pairs = [_written_number(v) for pair in zip(ratios, times, strict=True) for v in pair]
    data = [f"TBDATA,{k + 1},{','.join(pairs[k : k + 6])}" for k in range(0, len(pairs), 6)]
    lines = ["! SI units: Pa, s. Add MP,DENS.", f"! {_span(model)}", "TB,HYPER,1,1,2,NEO"]
    lines.append(f"TBDATA,1,{_written_number(float(G0))},{_written_number(2 / _bulk(float(G0)))}")
    for option in ("SHEAR", "BULK"):
        lines += [f"TB,PRONY,1,1,{len(ratios)},{option}", *data]
    return "\n".join([*lines, ""])


def sofa(model: Maxwell, equilibrium_error: float = 0.0) -> str:
    """Return a hyperelastic force field for SOFA with the equilibrium modulus, or with G0 if the equilibrium modulus
    cannot be distinguished from zero (a fluid). SOFA has no Prony series, so the series is in a comment.
    `equilibrium_error`: standard error [Pa] of the equilibrium modulus.

    The energy of SOFA's law is mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2. So the second parameter is Lame's lambda,
    not the bulk modulus.
    """
    G0, ratios, times = model
    solid = _is_solid(model, equilibrium_error)
    shear = equilibrium_of(model) if solid else float(G0)
    what = "equilibrium" if solid else "instantaneous (the model is a fluid, within the error of the fit)"
    modes = "; ".join(f"{_written_number(g)} {_written_number(t)}" for g, t in zip(ratios, times, strict=True))
    return (
        f"<!-- SI units: Pa, s. The {what} shear modulus of these modes: SOFA has no Prony series.\n"
        f"     {_span(model)}\n"
        f"     G0 {_written_number(float(G0))}; ratio and relaxation time of each mode: {modes} -->\n"
        '<TetrahedronHyperelasticityFEMForceField materialName="NeoHookean" '
        f'ParameterSet="{_written_number(shear)} {_written_number(_bulk(shear) - 2 * shear / 3)}" />\n'
    )
