"""Maps of scenes whose regions set the mapped parameter: there the map has no values."""

import json
from types import SimpleNamespace

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from test_field import _SCENE, _write

import liverjax as lj
from fitting.__main__ import main
from fitting.fits import field
from liverjax.core.errors import InputError
from liverjax.core.struct import replace

pytestmark = pytest.mark.quick_to_compile


def test_elements_keep_the_numbers_of_their_regions():
    """Where a region of the scene sets mu, a map of mu showed its own values, which the runs did not use."""
    box = lj.shapes.box((2.0, 1.0, 1.0), (2, 1, 1))  # 12 elements
    soft = lj.laws.NeoHookean(mu=500.0, bulk=2000.0)
    regions = (
        lj.Region(elements=jnp.arange(0, 4), law={"mu": 3000.0}, viscosity={"ratios": jnp.array([0.1, 0.2])}),
        lj.Region(elements=jnp.arange(3, 6), law=lj.laws.create("mooney_rivlin", c10=1.0, c01=1.0, bulk=2.0)),
    )
    scene = lj.Scene(mesh=box, law=soft, region=regions)
    problem = SimpleNamespace(scenes=(scene,))
    given, values = field.given_by_regions(problem, "law.mu")
    assert np.array_equal(given, np.arange(12) < 6)
    assert np.all(values[:3] == 3000) and np.all(np.isnan(values[3:]))
    given, values = field.given_by_regions(problem, "viscosity.ratios.1")
    assert np.array_equal(given, np.arange(12) < 4) and np.all(values[:4] == 0.2)
    # A parameter that another scene leaves free in this region is mapped.
    both = SimpleNamespace(scenes=(scene, replace(scene, region=())))
    assert not np.any(field.given_by_regions(both, "law.mu")[0])
    every = replace(scene, region=(lj.Region(elements=jnp.arange(12), law={"mu": 1.0}),))
    with pytest.raises(InputError, match="so nothing is left to map"):
        field.start_of(SimpleNamespace(scenes=(every,)), "law.mu")


@pytest.mark.slow
def test_a_map_shows_the_numbers_that_the_runs_use(tmp_path, capsys):
    """A region of the scene sets mu in the upper half, as in the truth. The map showed 900 to 1,100 Pa there."""
    (tmp_path / "s.toml").write_text(
        _SCENE.format(mu=800.0, gravity="4, 0, -3") + "[[region]]\nwhere = {x_min = 0.03}\nlaw = {mu = 3000.0}\n"
    )
    scene = lj.load_scene(tmp_path / "s.toml")
    data = _write(tmp_path / "d.csv", scene, 2e-5, mu=1000.0)
    assert main(["field", str(tmp_path / "s.toml"), str(data), "--noise", "2e-5", "--out", str(tmp_path / "o")]) == 0
    assert "keep the law.mu of their [[region]]: the map has no value there" in capsys.readouterr().err
    with h5py.File(tmp_path / "o" / "field.h5") as f:
        modulus, given, sd = f["modulus"][:], f["given"][:], f["sd_of_ln"][:]
    assert given.sum() == len(given) // 2 and np.all(modulus[given] == 3000)
    told = json.loads((tmp_path / "o" / "field.json").read_text())["map"]
    assert told["largest_standard_deviation_of_ln"] == pytest.approx(np.nanmax(sd)) and np.isnan(sd).any()
    assert abs(np.median(modulus[~given]) / 1000 - 1) < 0.15
