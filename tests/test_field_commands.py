"""Maps from the command line."""

import json
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from test_field import _SCENE, _scene, _write

import liverjax as lj
from fitting.__main__ import main
from fitting.commands import field

pytestmark = pytest.mark.quick_to_compile


@pytest.mark.slow
def test_the_command_maps_quadratic_elements(tmp_path):
    (tmp_path / "scene.toml").write_text(
        _SCENE.format(mu=1000.0, gravity="4, 0, -3").replace("[law]", "order = 2\n[law]")
    )
    scene = lj.load_scene(tmp_path / "scene.toml")
    u = np.asarray(lj.simulate(scene).check().positions[-1] - scene.mesh.points)
    rows = np.c_[np.arange(60), u[:60]]
    np.savetxt(tmp_path / "u.csv", rows, delimiter=",", header="node,ux,uy,uz", comments="")
    files = [str(tmp_path / "scene.toml"), str(tmp_path / "u.csv")]
    assert main(["field", *files, "--noise", "5e-5", "--length", "0.03", "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "field.json").read_text())["map"]["largest"] < 1100


@pytest.mark.draws
@pytest.mark.slow
def test_the_command_maps(tmp_path, capsys):
    """Estimate a map from files and check all written files. The next test checks that a fit continues from them."""
    scene = _scene(tmp_path, mu=1000.0)
    _write(tmp_path / "u.csv", scene, 5e-5)
    out = tmp_path / "out"
    command = ["field", str(tmp_path / "scene.toml"), str(tmp_path / "u.csv"), "--noise", "5e-5", "--out", str(out)]
    assert main([*command, "--length", "0.02", "--iterations", "3"]) in (0, 1)
    said = capsys.readouterr()
    assert "gradients need about" in said.err and "prior sd" in said.out
    found = json.loads((out / "field.json").read_text())
    assert found["map"]["smallest"] < found["map"]["largest"]
    for name in ("field.vtu", "field.h5", "field.png", "progress.h5"):
        assert (out / name).stat().st_size > 0


@pytest.mark.slow
def test_the_command_goes_on(tmp_path, capsys):
    scene = _scene(tmp_path, mu=1000.0)
    _write(tmp_path / "u.csv", scene, 5e-5)
    files = [str(tmp_path / "scene.toml"), str(tmp_path / "u.csv")]
    command = ["field", *files, "--noise", "5e-5", "--out", str(tmp_path / "out"), "--length", "0.02"]
    assert main([*command, "--iterations", "15"]) in (0, 1)
    first = json.loads((tmp_path / "out" / "field.json").read_text())
    assert main([*command, "--iterations", "5", "--resume"]) in (0, 1)
    again = json.loads((tmp_path / "out" / "field.json").read_text())
    name = "chi2_per_component"
    assert again["map"][name] <= 1.001 * first["map"][name]


def test_unknown_effects_are_kept_for_the_file():
    """A warning that the mesh error is unknown was printed, but it was not in field.json."""
    sentence = "the effect of the mesh error on the fit is unknown: a step failed"
    with pytest.warns(UserWarning) as told, field._unknown_effects() as unknown:
        warnings.warn(sentence, stacklevel=1)
        warnings.warn("another", stacklevel=1)
    assert unknown == [sentence] and [str(one.message) for one in told] == [sentence, "another"]


@pytest.mark.filterwarnings("ignore:the effect of the mesh error on the fit is unknown")
def test_a_fit_whose_mesh_error_is_unknown_tells_it_in_its_file(tmp_path, monkeypatch):
    sentence = "the effect of the mesh error on the fit is unknown: a step failed"

    def fitted(problem, names, progress):
        warnings.warn(sentence, stacklevel=1)
        one = np.ones(1)
        return SimpleNamespace(converged=True, names=names, values=one)

    monkeypatch.setattr(field.scene_numbers, "fit_numbers", fitted)
    monkeypatch.setattr(field.field_report, "table_of_numbers", lambda _: "")
    monkeypatch.setattr(field.field_report, "misfit_sentence", lambda _: None)
    monkeypatch.setattr(field.field_report, "of_numbers", lambda _: {"warnings": []})
    scene = _scene(tmp_path, mu=1000.0)
    np.savetxt(
        tmp_path / "u.csv",
        np.zeros((9, 4)) + np.arange(9)[:, None] * [1, 0, 0, 0],
        delimiter=",",
        header="node,ux,uy,uz",
        comments="",
    )
    files = [str(tmp_path / "scene.toml"), str(tmp_path / "u.csv")]
    assert scene.mesh.number_of_nodes > 9
    assert main(["field", *files, "--noise", "5e-5", "--parameters", "law.mu", "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "field.json").read_text())["warnings"] == [sentence]
