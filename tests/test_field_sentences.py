"""Messages on a map and on parameters estimated from displacements: misfit, undetermined level and parameters."""

from types import SimpleNamespace

import numpy as np
import pytest

import liverjax as lj
from fitting.__main__ import main
from fitting.commands import field as field_command
from fitting.fits import field, inclusion
from fitting.methods.estimate import Estimate, bias_sentences
from fitting.reports import field_report

pytestmark = pytest.mark.quick_to_compile


def test_chance_in_the_residuals_of_a_map_is_no_warning():
    """For 240 components, chi2 per component is 1 +- 0.09."""
    for chi2, told in ((1.01, False), (1.25, False), (1.3, True)):
        found = SimpleNamespace(reached=False, chi2=240 * chi2, components=240)
        assert (field_report.noise_sentence(found) is not None) == told


def test_a_fit_that_misses_the_data_says_so():
    found = Estimate(
        ("law.mu",), np.ones(1), np.ones((1, 1)), np.ones(1), np.ones((1, 1)), 90.0, 60, 1.0, 59.0, 3, True
    )
    assert field_report.misfit_sentence(found._replace(chi2=89.0)) is None
    said = field_report.misfit_sentence(found._replace(chi2=0.6))  # a noise that was given in millimetres
    assert said is not None and "scatter 0.1 times as much as the stated noise" in said
    assert "in metres (--noise), or in the unit of the file (column sd)" in said
    assert field_report.misfit_sentence(found._replace(chi2=0.6), with_mesh=True) is None
    said = field_report.misfit_sentence(found._replace(chi2=240.0))
    assert said is not None and "chi2 stays at 4 per component" in said and "by 2 times their noise" in said
    assert said.endswith("a larger noise (--noise in metres, or the column sd in the unit of the file)")
    assert field_report.of_numbers(found._replace(chi2=240.0))["warnings"] == [said] and "the mesh's error" not in said
    said = field_report.misfit_sentence(found._replace(chi2=240.0, mesh_over_noise=3.0))
    assert said is not None and "the mesh's error in the data is 3 times the noise: refine the mesh" in said
    said = field_report.misfit_sentence(found._replace(chi2=240.0, standard_errors=np.array([np.inf])))
    assert said is not None and said.startswith("no values of law.mu explain the displacements")


def test_the_warnings_about_a_map_are_in_its_content():
    """field.json had no warnings about a map: they were only printed. The deviation of the level was not written."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    n, E = mesh.number_of_nodes, mesh.number_of_elements
    ones = np.ones(n)
    found = field.Field(
        *("law.mu", 0 * ones, np.ones(E), 0.3 * ones, ones, 0.4 * ones, None, 0.1, 0.02, 500.0, 240, False, 2.0),
        *([], np.ones(3), (0,), 1.0, np.zeros(E, bool), 9.0),
    )
    content = field_report.of_field(mesh, found)
    assert content["standard_deviation_of_level_of_ln"] == 9.0
    for said, words in zip(
        content["warnings"], ("chi2 stays at", "the search stopped", "level of the map", "mesh"), strict=True
    ):
        assert words in said


def test_nodes_without_a_map_do_not_count():
    """The report gave 50 % as the largest bias, at a node where a region sets the parameter. A small standard deviation
    at this node hid that the level was open."""
    mesh = lj.shapes.box((2.0, 1.0, 1.0), (2, 1, 1))
    given = np.arange(mesh.number_of_elements) < mesh.number_of_elements // 2
    nodes = mesh.element_nodes_on_host
    lost = np.isin(np.arange(mesh.number_of_nodes), np.setdiff1d(nodes[:, given], nodes[:, ~given]))
    assert lost.sum() == 4
    sd, bias, m = np.where(lost, 0.01, 0.6), np.where(lost, 0.5, 0.1), np.zeros(len(lost))
    found = field.Field(
        *("law.mu", m, np.ones(len(given)), sd, m + 1, bias, bias, 0.1, 0.02, 240.0, 240, True, 0.0),
        *([], np.ones(3), (0,), 1.0, given, 0.1),
    )
    content = field_report.of_field(mesh, found)
    assert content["largest_mesh_bias_of_ln"] == content["largest_time_step_bias_of_ln"] == 0.1
    (said,) = content["warnings"]
    assert said.startswith("the data do not determine the level of the map: at every mapped node")


def test_a_uniform_map_gives_no_sphere(capsys):
    """The start was NaN, and the message was that the fit diverged."""
    mesh = lj.shapes.box((1.0, 1.0, 1.0), (1, 1, 1))
    problem = SimpleNamespace(scenes=(SimpleNamespace(mesh=mesh),))
    found = SimpleNamespace(name="law.mu", log_factor=np.zeros(8), sd=np.full(8, 0.1))
    with pytest.raises(lj.InputError, match=r"the map of law.mu is uniform, so no sphere can be placed"):
        inclusion.start_from(problem, found)
    content, converged = field_command._sphere(problem, found, False)  # the command still writes the map
    assert not converged and capsys.readouterr().err == f"warning: {content['warnings'][0]}\n"


@pytest.mark.parametrize(
    ("sd", "bias", "level", "mesh"),
    [
        # a bar under prescribed displacements only: the message named the mesh, and no other cause
        ([3.0, 3.4], [0.46, 0.1], True, None),
        ([0.05, 3.0], [0.04, 0.46], False, None),
        ([0.05, 0.6], [0.5, 0.1], False, "by up to 50%, which is too much"),
        ([0.05, 0.6], [0.1, 0.5], False, "by up to 10%"),
        ([0.05, 0.6], [0.1, 0.1], False, "at 50% of the nodes"),
    ],
)
def test_a_map_whose_level_is_open_says_so_and_the_mesh_is_blamed_for_its_own_share(sd, bias, level, mesh):
    found = SimpleNamespace(sd=np.array(sd), mesh_bias=np.array(bias), time_step_bias=None, level_sd=0.1)
    assert (field.level_sentence(found) is not None) == level
    said = field.map_bias_sentences(found)
    assert said == [] if mesh is None else len(said) == 1 and mesh in said[0]
    stepped = SimpleNamespace(sd=np.array(sd), mesh_bias=None, time_step_bias=np.array(bias))
    assert field.map_bias_sentences(stepped) == [
        one.replace("refine the mesh", "use smaller time steps")
        .replace("mesh", "time step")
        .replace("time step_", "time_step_")
        for one in said
    ]


@pytest.mark.parametrize(("cells", "told"), [(2, True), (6, False)])
@pytest.mark.parametrize("order", [1, 2])
def test_a_sphere_as_small_as_the_elements_is_told(cells, order, told):
    """With an edge of 0.8 radii, the modulus of a sphere was wrong by 29 %, or seven standard errors."""
    mesh = lj.shapes.box((0.1, 0.1, 0.1), (cells,) * 3)
    mesh = lj.quadratic(mesh) if order == 2 else mesh
    found = SimpleNamespace(values=np.array([0.05, 0.05, 0.05, 0.03, 1000.0, 3000.0]))
    said = inclusion.size_sentence(mesh, found)
    assert (said is not None) == told
    assert said is None or "is only 0.53 times the edges of the elements (0.056 m)" in said


def test_a_number_is_named_once(tmp_path, capsys):
    """The second fit returned its starting value as the result, with an infinite error."""
    (tmp_path / "scene.toml").write_text(
        '[mesh]\nshape = "box"\nsize = [1, 1, 1]\ncells = [1, 1, 1]\n[law]\nname = "neo_hookean"\nmu = 1\nbulk = 9\n'
        '[[fixed]]\nset = "z_min"\n[[traction]]\nset = "z_max"\nvalue = [0, 0, 0.1]\n'
    )
    (tmp_path / "seen.csv").write_text("node,ux,uy,uz\n7,0,0,0.01\n")
    command = ["field", str(tmp_path / "scene.toml"), str(tmp_path / "seen.csv"), "--noise", "1e-3"]
    assert main([*command, "--parameters", "law.mu,law.mu", "--out", str(tmp_path / "out")]) == 2
    assert "--parameters names law.mu twice: remove one" in capsys.readouterr().err


def test_numbers_that_no_mesh_determines_are_not_blamed_on_the_mesh():
    """Two moduli are in series under prescribed displacements only. The result was 938 ± 7e9, and the message advised a
    finer mesh.
    """
    found = {"names": ("mu", "law.mu"), "values": np.array([938.0, 2900.0]), "mesh_bias": np.array([2e3, 3e3])}
    found["time_step_bias"] = None
    (said,) = bias_sentences(SimpleNamespace(**found, standard_errors=np.array([7e9, 1e10])))
    assert said.startswith("the data do not determine mu, law.mu") and "refine" not in said
    (said,) = bias_sentences(SimpleNamespace(**found, standard_errors=np.array([10.0, 10.0])))
    assert "by more than 30%" in said
    assert bias_sentences(SimpleNamespace(**found, standard_errors=np.array([5e3, 5e3]))) == []
    unknown = found | {"mesh_bias": np.full(2, np.nan)}
    (said,) = bias_sentences(SimpleNamespace(**unknown, standard_errors=np.array([5e3, 5e3])))
    assert said.startswith("the effect of the mesh on the fit is unknown")


@pytest.mark.parametrize(("size", "title"), [(10e-6, "x = 0.00050 cm"), (0.1, "x = 5.0 cm")])
def test_the_places_of_sections_have_the_digits_of_the_body(size, title):
    """The figure of a body of 10 um was named "x = 0.0 cm"."""
    mesh = lj.shapes.box((size, size, size), (2, 2, 2))
    middle = np.all(np.isclose(mesh.points, size / 2), axis=1)
    found = SimpleNamespace(
        name="mu", log_factor=1.0 * middle, sd=np.ones(27), given=np.zeros(len(mesh.tetrahedra), bool)
    )
    figure = field_report.map_figure(mesh, found)
    assert figure.axes[0].get_title() == title
