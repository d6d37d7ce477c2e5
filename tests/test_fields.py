"""Fields of a run compared with a body in uniform strain, and a table of forces over time."""

import h5py
import meshio
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.errors import InputError
from liverjax.jobs import fields
from liverjax.physics.boundary import boundary_triangles
from liverjax.scenes.scene_file import scene_from
from liverjax.simulation.run import Result

pytestmark = pytest.mark.quick_to_compile

SCENE = """
[mesh]
shape = "box"
size = [0.1, 0.1, 0.1]
cells = [1, 1, 1]
[law]
name = "neo_hookean"
mu = 800.0
bulk = 4000.0
[[fixed]]
where = {z_max = 0.0}
[[displaced]]
where = {z_min = 0.1}
by = [0.01, 0.0, 0.0]
[solve]
steps = 2
[output]
fields = ["cauchy_stress", "volume_ratio"]
reactions = true
"""
NAMES = ["cauchy_stress", "green_strain", "principal_stretches", "volume_ratio", "energy"]


def content(**more) -> dict:
    return {
        "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1], "cells": [1, 1, 1]},
        "law": {"name": "neo_hookean", "mu": 800.0, "bulk": 4000.0},
        "fixed": [{"where": {"z_max": 0.0}}],
        "solve": {"dt": 0.1, "steps": 2},
    } | more


def shown(scene: lj.Scene, positions, names, pressure=None, start=None) -> dict:
    """Return fields at given positions (T, V, 3), as if they were the result of a run."""
    T = len(positions)
    zero = np.zeros(np.shape(positions))
    result = Result(
        times=np.arange(T), positions=positions, reactions=zero, status=np.zeros(T), pressure=pressure, statistics=None
    )
    return fields.fields(scene, result, names, start)


@pytest.mark.parametrize("volumetric", ["element", "mixed"])
@pytest.mark.parametrize("order", [1, 2])
def test_uniform_strain_has_the_fields_of_one_point(order, volumetric):
    """The results do not contain the pressures of mixed bodies. In equilibrium they follow from the volumes."""
    solve = {"steps": 1, "volumetric": volumetric}
    scene = scene_from(content(mesh=content()["mesh"] | {"order": order}, solve=solve))
    F = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, 0.0, 1.1]])
    x = np.asarray(scene.mesh.points) @ F.T
    found, J = shown(scene, x[None], NAMES), np.linalg.det(F)
    exact = {
        "cauchy_stress": np.asarray(scene.law.first_piola(F)) @ F.T / J,
        "green_strain": 0.5 * (F.T @ F - np.eye(3)),
        "principal_stretches": np.sqrt(np.linalg.eigvalsh(F.T @ F))[::-1],
        "volume_ratio": J,
        "energy": float(scene.law.energy(F)),
    }
    for name, value in exact.items():
        assert found[name].shape[:2] == (1, scene.mesh.number_of_elements)
        assert np.allclose(found[name][0], value, rtol=1e-10, atol=1e-12)
        nodes = fields.at_vertices(scene.mesh, found[name])
        assert nodes.shape[:2] == (1, scene.mesh.number_of_vertices) and np.allclose(
            nodes[0], value, rtol=1e-10, atol=1e-12
        )


@pytest.mark.parametrize("volumetric", ["nodal", "mixed"])
def test_the_energy_of_a_nearly_incompressible_body_is_the_work(volumetric):
    """The volume ratios of single elements gave 358 times the energy of a body with averaged volumes."""
    body = content()["mesh"] | {"cells": [2, 2, 2]}
    law = {"name": "neo_hookean", "mu": 1e3, "bulk": 1e7}
    pulled = [{"where": {"z_min": 0.1}, "by": [0.0, 0.0, 1e-4]}]
    solve = {"steps": 1, "volumetric": volumetric, "tolerance": 1e-10}
    scene = scene_from(content(mesh=body, law=law, displaced=pulled, solve=solve))
    result = lj.simulate(scene).check()
    top = np.asarray(scene.displaced[0].nodes)
    work = 0.5 * 1e-4 * float(np.asarray(result.reactions)[-1, top, 2].sum())
    found = fields.fields(scene, result, ["energy"])["energy"][-1] @ np.asarray(scene.mesh.volumes)
    assert np.isclose(found, work, rtol=5e-3)  # the strain is 0.1 %, so the force is linear to about this


def test_a_field_named_twice_is_there_once():
    scene = scene_from(content())
    assert shown(scene, np.asarray(scene.mesh.points)[None], ["energy", "energy"])["energy"].shape[0] == 1


def test_a_held_viscous_body_relaxes():
    """The body is strained in the first step and then constant. The stress of the second step is relaxed by the
    series.
    """
    prony = {"ratios": [0.5], "relaxation_times": [0.1]}
    viscous, plain = scene_from(content(viscosity=prony)), scene_from(content())
    F = np.diag([1.3, 0.9, 0.95])
    x = np.asarray(viscous.mesh.points) @ F.T
    stress, elastic = (shown(s, np.stack([x, x]), ["cauchy_stress"])["cauchy_stress"] for s in (viscous, plain))
    h = 0.1 / 0.1
    # A ramp over the first step, then constant strain (exponential recursion).
    first = 0.5 + 0.5 * (1 - np.exp(-h)) / h
    second = 0.5 + 0.5 * (1 - np.exp(-h)) / h * np.exp(-h)
    assert np.allclose(stress[0], first * elastic[0], rtol=1e-9, atol=1e-9)
    assert np.allclose(stress[1], second * elastic[1], rtol=1e-9, atol=1e-9)


def test_a_body_that_begins_strained_relaxes_from_there():
    """A dynamic run begins with the whole elastic stress at `start`. The fields began at the reference positions."""
    moving = {"body": {"density": 1000.0}, "solve": {"dt": 0.1, "steps": 2, "kind": "dynamic"}}
    viscous, plain = (
        scene_from(content(**moving, **more))
        for more in ({"viscosity": {"ratios": [0.5], "relaxation_times": [0.1]}}, {})
    )
    x = np.asarray(viscous.mesh.points) @ np.diag([1.3, 0.9, 0.95])
    stress, elastic = (
        shown(s, np.stack([x, x]), ["cauchy_stress"], start=x)["cauchy_stress"] for s in (viscous, plain)
    )
    left = 0.5 + 0.5 * np.exp(-np.array([1.0, 2.0]))
    assert np.allclose(stress, left[:, None, None, None] * elastic, rtol=1e-9, atol=1e-9)


def test_fluid_flows_down_the_pressure():
    sponge = {"bulk": 400.0, "limit_bulk": 2200.0, "fluid_fraction": 0.5, "permeability": 2e-6}
    scene = scene_from(content(porosity=sponge))
    F = np.diag([1.2, 1.0, 0.8])
    X = np.asarray(scene.mesh.points)
    pressure = 50.0 + 300.0 * (X @ F.T)[:, 0]
    found = shown(scene, (X @ F.T)[None], ["fluid_velocity"], pressure[None])
    assert np.allclose(found["fluid_velocity"][0], [-2e-6 * 300.0, 0.0, 0.0], atol=1e-16)


@pytest.mark.slow
def test_what_a_command_writes(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    from liverjax.__main__ import main

    assert (
        main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path), "--vtu", "--fields", "green_strain"])
        == 0
    )
    with h5py.File(tmp_path / "result.h5") as file:
        assert set(file["fields/elements"]) == {"cauchy_stress", "volume_ratio", "green_strain"}
        assert file["fields/vertices/cauchy_stress"].shape == (2, 8, 3, 3)
        assert file["fields/elements/cauchy_stress"].attrs["unit"] == "Pa"
        reactions = file["reactions"][:]
    table = np.genfromtxt(tmp_path / "reactions.csv", delimiter=",", names=True)
    assert np.allclose(
        table["fixed0x_N"], reactions[:, :, 0][:, np.isin(np.arange(8), [0, 2, 4, 6])].sum(axis=1), rtol=1e-6
    )
    assert np.allclose(table["fixed0x_N"], -table["displaced0x_N"], rtol=1e-6)
    assert meshio.read(tmp_path / "vtu" / "step_00002.vtu").cell_data["green_strain"][0].shape == (6, 9)


def test_bad_fields_are_refused():
    scene = scene_from(content())
    for names, words in (
        (["cauchy_stres"], "did you mean cauchy_stress"),
        (["fluid_velocity"], "needs \\[porosity\\]"),
    ):
        with pytest.raises(InputError, match=words):
            fields.check(names, scene)
    with pytest.raises(InputError, match="must be a list of names"):
        scene_from(content(output={"fields": "cauchy_stress"}))


@pytest.mark.draws
def test_a_field_of_a_result_is_drawn(tmp_path, capsys):
    """In uniaxial tension, the von Mises stress is the tensile stress. A missing field gives a one-line message."""
    from liverjax.__main__ import main
    from liverjax.jobs import pictures

    mesh, file = scene_from(content()).mesh, tmp_path / "result.h5"
    X = np.asarray(mesh.points)
    V = len(X)
    with h5py.File(file, "w") as out:
        out["reference"], out["tetrahedra"] = X, np.asarray(mesh.tetrahedra)
        out["positions"] = np.stack([X, X * [1.1, 1.0, 1.0]])
        out["fields/vertices/cauchy_stress"] = np.broadcast_to(np.diag([-70.0, 0.0, 0.0]), (2, V, 3, 3))
        out["fields/vertices/green_strain"] = np.broadcast_to(np.diag([0.105, 0.0, -0.2]), (2, V, 3, 3))
    assert np.allclose(pictures.of_result(file, "cauchy_stress").values, 70.0)
    assert np.allclose(pictures.of_result(file, "green_strain", 1).values, 0.105)
    drawn = pictures.of_result(file, "displacement")
    assert np.allclose(drawn.values, 0.1 * np.abs(X[:, 0])) and np.allclose(drawn.after, X * [1.1, 1.0, 1.0])
    assert len(drawn.triangles) == len(boundary_triangles(mesh))
    assert main(["plot", str(file), "--field", "cauchy_stress", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "cauchy_stress.png").stat().st_size > 5000
    assert "von Mises stress [Pa]: 70 to 70" in capsys.readouterr().out
    for more, words in (
        (["--field", "energy"], "has no field 'energy'"),
        (["--step", "3"], "--step 3 is not in"),
        (["yeoh"], "give only this file"),
        (["--stretch", "0.9", "1.1"], "--stretch is for laws, not for"),
    ):
        assert main(["plot", str(file), *more, "--out", str(tmp_path)]) == 2
        assert words in capsys.readouterr().err
    with h5py.File(tmp_path / "reduced.h5", "w") as out:
        out["modes"] = np.zeros((2, 4, 3))
    assert main(["plot", str(tmp_path / "reduced.h5")]) == 2
    assert "contains a reduced model: run this model" in capsys.readouterr().err
    (tmp_path / "other.h5").write_text("no")
    assert main(["plot", str(tmp_path / "other.h5")]) == 2
    assert "is not a result of liverjax simulate" in capsys.readouterr().err
    assert main(["plot", str(tmp_path)]) == 2  # the folder was taken for the name of a law
    assert "is a file or a folder, and not a law: give the name of a law" in capsys.readouterr().err
