"""Material cards, read back in the way the target program reads them: the moduli are those of the model."""

import re
import tomllib
import types
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from conftest import ROOT

from fitting.__main__ import main
from fitting.commands import shared_options
from fitting.fits.honesty.long_times import INTERVAL
from fitting.methods.generalised_maxwell import Maxwell
from fitting.reports import material_cards
from liverjax.scenes.scene_file import scene_from

OMEGA = np.geomspace(0.01, 100, 9)
SOLID = Maxwell(np.array(770.0), np.array([0.235, 0.333]), np.array([0.27, 0.03]))
FLUID = Maxwell(np.array(770.0), np.array([0.6, 0.4]), np.array([0.27, 0.03]))
MANY = Maxwell(np.array(1e4), np.full(7, 0.1), np.geomspace(100, 1e-3, 7))


def complex_modulus(rest, strengths, times, omega=OMEGA):
    """Return the sum over the equilibrium modulus [Pa] and the modes [Pa, s], without code of the project."""
    s = 1j * omega[:, None] * np.asarray(times)
    return rest + (np.asarray(strengths) * s / (1 + s)).sum(axis=1)


def exact(model):
    G0, g, tau = (np.asarray(v) for v in model)
    return complex_modulus(G0 * (1 - g.sum()), G0 * g, tau)


def from_febio(text):
    """Return the modulus of FEBio's card.

    Stress = integral of G(t - s) dS_elastic/ds with G(t) = g0 + sum g_i exp(-t / t_i) (FEBio theory manual, 5.3).
    """
    material = ET.fromstring(text.split("?>", 1)[1]).find("Material/material")
    terms = {e.tag: float(e.text) for e in material if e.tag != "elastic"}
    shear = float(material.find("elastic/E").text) / (2 * (1 + float(material.find("elastic/v").text)))
    n = len([t for t in terms if t.startswith("t")])
    strengths, times = ([terms[f"{c}{k}"] for k in range(1, n + 1)] for c in "gt")
    return complex_modulus(shear * terms["g0"], shear * np.array(strengths), times)


def from_abaqus(text):
    """Return the modulus of Abaqus's card: G0 = 2 C10, K0 = 2 / D1; one line of g, k, tau per mode (Abaqus Analysis
    User's Guide, time domain viscoelasticity).
    """
    keyword, rows = "", {}
    for line in text.splitlines():
        if line.startswith("*") and not line.startswith("**"):
            keyword = line.split(",")[0]
        elif keyword and not line.startswith("**") and line.strip():
            rows.setdefault(keyword, []).append([float(v) for v in line.split(",")])
    C10, D1 = rows["*HYPERELASTIC"][0]
    g, k, tau = np.array(rows["*VISCOELASTIC"]).T
    assert np.array_equal(g, k) and g.sum() < 1 and "MODULI=INSTANTANEOUS" in text
    assert 3 * (2 / D1) / (2 * 2 * C10) > 20  # nearly incompressible
    return complex_modulus(2 * C10 * (1 - g.sum()), 2 * C10 * g, tau)


def from_ansys(text):
    """Return the modulus of Ansys's card: mu, d of TB,HYPER,,,,NEO and pairs a_i, t_i of TB,PRONY (Ansys material
    reference).
    """
    tables, now = {}, ""
    for line in text.splitlines():
        cells = line.split(",")
        if cells[0] == "TB":
            now = cells[1] + (cells[5] if cells[1] == "PRONY" else "")
            tables[now] = {}
            if cells[1] == "PRONY":
                tables[now]["terms"] = int(cells[4])
        elif cells[0] == "TBDATA":
            assert len(cells) <= 8  # six numbers per line
            tables[now] |= {int(cells[1]) + k: float(v) for k, v in enumerate(cells[2:])}
    assert tables["PRONYSHEAR"] == tables["PRONYBULK"]
    n, shear = tables["PRONYSHEAR"]["terms"], tables["HYPER"][1]
    a, tau = (np.array([tables["PRONYSHEAR"][2 * k + j] for k in range(n)]) for j in (1, 2))
    return complex_modulus(shear * (1 - a.sum()), shear * a, tau)


def from_liverjax(text):
    """Return the modulus of a scene file: shear modulus of the law at rest, and the part of it that each mode
    relaxes.
    """
    body = '[mesh]\nshape = "box"\nsize = [1, 1, 1]\ncells = [1, 1, 1]\n[[fixed]]\nwhere = {z_max = 0.0}\n'
    motion = "[[displaced]]\nwhere = {z_min = 1.0}\nby = [0.01, 0, 0]\n[solve]\ndt = 0.01\n"
    scene = scene_from(tomllib.loads(body + motion + text), ".")
    shear, bulk = float(scene.law.shear_modulus()), float(scene.law.bulk_modulus())
    assert (3 * bulk - 2 * shear) / (6 * bulk + 2 * shear) == pytest.approx(material_cards.POISSON)
    g = np.asarray(scene.viscosity.ratios)
    return complex_modulus(shear * (1 - g.sum()), shear * g, scene.viscosity.relaxation_times)


@pytest.mark.parametrize("model", [SOLID, FLUID, MANY], ids=["solid", "fluid", "many modes"])
def test_cards_read_back_are_the_model(model, tmp_path):
    told = material_cards.write(tmp_path, model)
    readers = {"febio.feb": from_febio, "abaqus.inp": from_abaqus, "ansys.inp": from_ansys}
    readers["liverjax.toml"] = from_liverjax
    for name, reader in readers.items():
        if name == "febio.feb" and len(model.ratios) > 6:
            assert not (tmp_path / name).exists() and "FEBio has at most 6 modes" in told[0]
            continue
        # Numbers have ten digits. For a fluid, Abaqus and liverjax keep a millionth of G0.
        off = np.abs(reader((tmp_path / name).read_text()) - exact(model))
        assert np.all(off <= 1e-8 * np.abs(exact(model)) + 2e-6 * float(model.shear_modulus) * (model is FLUID)), name
    assert any("fluid" in t for t in told) == (model is FLUID)


@pytest.mark.parametrize("card", ["scene_tables", "febio", "abaqus", "ansys", "sofa"])
def test_cards_say_which_times_they_hold(card):
    """The modes replace a springpot only in the measured band. A card alone does not show this."""
    text = getattr(material_cards, card)(SOLID)
    assert "Modes of 0.03 to 0.27 s: faster and slower relaxation is not in this card." in text


def test_the_card_of_sofa_is_the_equilibrium(tmp_path):
    field = ET.fromstring("<s>" + material_cards.sofa(SOLID) + "</s>")[0]
    mu, lame = (float(v) for v in field.get("ParameterSet").split())
    # The energy contains lambda/2 (ln J)^2, so nu = lambda / (2 (lambda + mu)).
    assert lame / (2 * (lame + mu)) == pytest.approx(material_cards.POISSON, abs=1e-9)
    assert mu == pytest.approx(770 * (1 - 0.568)) and field.get("materialName") == "NeoHookean"
    assert "of these modes" in material_cards.sofa(SOLID)
    numbers = re.search(r"each mode: (.*) -->", material_cards.sofa(SOLID))[1]
    assert numbers == "0.235 0.27; 0.333 0.03"


@pytest.mark.parametrize(("error", "solid"), [(0.2, True), (0.26, False), (np.inf, False)])
def test_the_card_of_sofa_has_stiffness_if_the_model_may_be_a_fluid(tmp_path, error, solid):
    """The card contained 0.46 ± 0.26 Pa, the equilibrium modulus of a fluid of 1100 Pa, without a note."""
    model = Maxwell(np.array(1100.0), np.array([0.6, 0.4 - 0.456 / 1100]), np.array([0.5, 0.03]))
    told = material_cards.write(tmp_path, model, error)
    shear = float(re.search(r'ParameterSet="(\S+)', (tmp_path / "sofa.xml").read_text())[1])
    assert shear == pytest.approx(0.456 if solid else 1100)
    assert told == [] if solid else "within the error of the fit (equilibrium modulus 0.456 Pa)" in told[0]


def test_the_command_gives_the_error_of_the_equilibrium_modulus_to_the_cards(tmp_path, capsys):
    noise = 1 + 0.005 * np.random.default_rng(3).standard_normal((2, 20))
    omega = 2 * np.pi * np.geomspace(0.1, 20, 20)
    G = complex_modulus(0.0, [660.0, 440.0], [0.5, 0.03], omega)
    command = [csv_of(tmp_path / "s.csv", G, omega, noise), "--method", "closed-form", "--modes", "2", "--cards"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().err
    assert "cannot be distinguished from zero (a fluid)" in told and "the card for SOFA contains G0 = 1100 Pa" in told


def csv_of(path, G, omega, noise):
    rows = [f"{w},{p},{q}" for w, p, q in zip(omega, G.real * noise[0], G.imag * noise[1], strict=True)]
    path.write_text("\n".join(["angular_frequency_rad_s,storage_modulus_Pa,loss_modulus_Pa", *rows]))
    return str(path)


def test_the_card_of_several_fluids_is_no_soft_solid(tmp_path, capsys):
    """The card contained an equilibrium modulus of 0.5 Pa, without a note. G0 is 1100 Pa."""
    omega, rng = 2 * np.pi * np.geomspace(0.1, 20, 20), np.random.default_rng(3)
    G, files = complex_modulus(0.0, [660.0, 440.0], [0.5, 0.03], omega), []
    for scale in (0.9, 1.0, 1.1):
        noise = 1 + 0.005 * rng.standard_normal((2, 20))
        files.append(csv_of(tmp_path / f"s{scale}.csv", scale * G, omega, noise))
    assert main([*files, "--modes", "2", "--cards", "--out", str(tmp_path / "out")]) == 0
    assert "the card for SOFA contains G0 = 1" in capsys.readouterr().err
    shear = re.search(r'ParameterSet="(\S+)', (tmp_path / "out" / "cards" / "sofa.xml").read_text())[1]
    assert float(shear) == pytest.approx(1094, rel=0.02)


def test_the_card_of_sofa_follows_the_interval_of_the_equilibrium_modulus(tmp_path, capsys):
    """The interval was 0 to 120 Pa, but the card contained 120 Pa without a note."""
    model = Maxwell(np.array(850.0), np.array([0.4, 0.45]), np.array([0.5, 0.03]))
    spread = types.SimpleNamespace(values=np.array([850.0, 0.4, 0.45, 0.5, 0.03]), root=np.eye(5) * 1e-6)
    for low in (0.0, 90.0):
        details = {INTERVAL: {"low": low, "high": 130.0}}
        fit = types.SimpleNamespace(model=model, uncertainty=spread, details=details)
        shared_options.write_cards_of_fit(tmp_path, fit)
        assert ("the card for SOFA contains G0 = 850 Pa" in capsys.readouterr().err) == (low == 0)


def test_the_command_writes_them(tmp_path, capsys):
    file = ROOT / "data" / "porcine_liver_frequency_sweep.csv"
    assert main([str(file), "--method", "closed-form", "--modes", "2", "--cards", "--out", str(tmp_path)]) == 0
    assert "/cards" in capsys.readouterr().out
    found = from_abaqus((tmp_path / "cards" / "abaqus.inp").read_text())
    assert np.allclose(found, exact(SOLID), rtol=1e-4)
