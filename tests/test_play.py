"""A body in the browser: time steps under a pull by the user, responses of the server, the command."""

import http.client
import json
import re
import threading
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import liverjax as lj
from liverjax.__main__ import main
from liverjax.core import status
from liverjax.core.errors import InputError
from liverjax.core.struct import replace
from liverjax.physics.attached.ligament import Ligament
from liverjax.play import pulling
from liverjax.play.server import PlayServer
from liverjax.scenes.scene_file import scene_from

pytestmark = pytest.mark.quick_to_compile


def cube(**solve):
    mesh = lj.shapes.box((0.02, 0.02, 0.02), (2, 2, 2))
    return lj.Scene(
        mesh=mesh,
        law=lj.laws.NeoHookean(mu=1000.0, bulk=3000.0),
        body=lj.Body(density=1000.0),
        fixed=(lj.Fixed(nodes=mesh.node_sets["z_min"]),),
        solve=lj.Solve(**solve),
    )


#: A node that is moved up by 4 mm in every body at rest, before the user pulls, and a node that is pulled.
RAISED, CORNER = 20, 26


def raised():
    up = (lj.Displaced(nodes=jnp.array([RAISED]), by=jnp.array([0.0, 0.0, 0.004])),)
    return replace(cube(steps=2), displaced=up)


@pytest.fixture(scope="module")
def still():
    return pulling.at_rest(raised())


@pytest.fixture(scope="module")
def moving():
    return pulling.at_rest(cube(kind="dynamic", dt=0.01))


@pytest.mark.slow
def test_a_pulled_body_rests_where_a_ligament_holds_it(still):
    """The pull equals a spring that is part of a scene, run with `simulate`."""
    to = still.positions[CORNER] + np.array([0.004, 0.002, 0.003])
    found = still
    for _ in range(2):
        found = pulling.pulled(found, CORNER, to, 5.0)
    assert found.code == status.CONVERGED and found.step == 2
    spring = Ligament(
        nodes=jnp.array([[CORNER]]), weights=jnp.ones((1, 1)), to=to, stiffness=5.0, rest_length=1e-3 * still.size
    )
    exact = lj.simulate(replace(raised(), physics=(spring,))).check().positions[-1]
    moved = np.abs(np.asarray(exact) - still.positions).max()
    assert moved > 1e-3
    np.testing.assert_allclose(found.positions, exact, atol=1e-7 * moved)
    back = pulling.pulled(found)
    np.testing.assert_allclose(back.positions, still.positions, atol=1e-7 * moved)


@pytest.mark.slow
def test_a_body_that_is_let_go_swings_and_the_time_goes_on(moving):
    found = moving
    for _ in range(5):
        found = pulling.pulled(found, CORNER, moving.positions[CORNER] + np.array([0.01, 0, 0]), 5.0)
    pulled = found.positions[CORNER, 0]
    assert found.time == pytest.approx(0.05) and pulled > moving.positions[CORNER, 0] + 1e-3
    after = pulling.pulled(found)
    assert after.positions[CORNER, 0] != pulled
    # A spring of zero length has no direction and no effect.
    none = pulling.pulled(moving, CORNER, moving.positions[CORNER], 5.0)
    assert none.code == status.CONVERGED
    np.testing.assert_allclose(none.positions, moving.positions, atol=1e-9)


@pytest.mark.slow
def test_a_step_that_fails_leaves_the_body_as_it_was(still):
    far = pulling.pulled(still, CORNER, still.positions[CORNER] - np.array([0, 0, 0.5]), 1e6)
    assert far.code not in (status.CONVERGED, status.ONE_STEP)
    assert far.step == 0 and far.positions is still.positions
    assert pulling.pulled(far).code == status.CONVERGED


@pytest.mark.ci
def test_loads_act_before_anyone_pulls(still, monkeypatch):
    rest = np.asarray(still.scene.mesh.points)
    np.testing.assert_allclose(still.positions[RAISED] - rest[RAISED], [0, 0, 0.004], atol=1e-12)
    with pytest.raises(InputError, match="cannot be used here"):
        pulling.at_rest(cube(kind="harmonic", frequencies=jnp.array([10.0])))
    failed = SimpleNamespace(status=np.array([status.CONVERGED, status.INDEFINITE]))
    monkeypatch.setattr(pulling, "compiled", lambda *_: lambda *_: (failed, None))
    with pytest.raises(InputError, match="load step 2 of 2 failed before the first pull: the stiffness"):
        pulling.at_rest(raised())


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_motions_end_where_a_run_ends_and_stay_there(precision):
    """A plane presses and nodes move within two time steps. The body moves as in the run, and then stays at rest."""
    content = {
        "mesh": {"shape": "box", "size": [0.02, 0.02, 0.02], "cells": [2, 2, 2]},
        "law": {"name": "neo_hookean", "mu": 1000.0, "bulk": 3000.0},
        "displaced": [{"where": {"z_max": 0.0}, "by": [0.0, 0.0, 0.001]}],
        "obstacle": [{"shape": "plane", "axis": [0, 0, -1], "position": [0, 0, 0.02], "by": [0, 0, -0.001]}],
        "solve": {"steps": 2, "dt": 0.1, "precision": precision, "tolerance": 1e-8 if precision == "float64" else 1e-4},
    }
    scene = scene_from(content)
    expected, playing = lj.simulate(scene).check().positions, pulling.at_rest(scene)
    assert np.ptp(expected[1][:, 2]) < 0.0185
    for k in range(3):
        playing = pulling.pulled(playing)
        # The errors are Newton's tolerance and the inactive spring. In float32, rounding is 1e-9 of the 2 cm.
        atol = 1e-8 if precision == "float64" else 2e-6
        np.testing.assert_allclose(playing.positions, expected[min(k, 1)], atol=atol)
        assert playing.code in (status.CONVERGED, status.ONE_STEP)


@pytest.fixture
def served(moving):
    with PlayServer(moving, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=60)

        def ask(method, path, content=None):
            connection.request(method, path, None if content is None else json.dumps(content))
            answer = connection.getresponse()
            return answer, answer.read()

        yield ask
        connection.close()
        server.shutdown()
        thread.join()


@pytest.mark.ci
def test_the_page_gets_a_surface_and_a_step_for_every_picture(served, moving):
    page = served("GET", "/")[1].decode()
    # nothing is loaded from other servers
    assert "<canvas" in page and 'fetch("/surface")' in page and "http" not in page
    surface = json.loads(served("GET", "/surface")[1])
    assert surface["nodes"] == moving.nodes.tolist() and len(surface["triangles"]) == 3 * 6 * 2 * 4
    assert max(surface["triangles"]) == len(surface["nodes"]) - 1 and surface["timed"]
    to = [float(v) for v in moving.positions[CORNER] + 0.005]
    answer, content = served("POST", "/step", {"node": CORNER, "to": to, "stiffness": 5.0})
    x = np.frombuffer(content, "<f4").reshape(-1, 3)
    assert answer.status == 200 and answer.headers["X-Time"] == "0.01" and answer.headers["X-Failed"] == ""
    at = surface["nodes"].index(CORNER)
    assert np.all(x[at] > np.asarray(surface["points"]).reshape(-1, 3)[at])
    answer, content = served("POST", "/rest", {})
    np.testing.assert_array_equal(np.frombuffer(content, "<f4"), np.asarray(surface["points"], "<f4"))


@pytest.mark.parametrize(
    "content, words",
    [
        ({"node": 27, "to": [0, 0, 0]}, "node = 27 is not in the mesh"),
        ({"node": "x", "to": [0, 0, 0]}, "node = 'x'"),
        ({"node": 1, "to": [0, 0]}, "three numbers in m"),
        ({"node": 1}, "three numbers in m"),
        ({"node": 1, "to": [0, 0, 0], "stiffness": -1}, "above 0 N/m"),
        ([1], "JSON object"),
    ],
)
def test_a_request_that_means_nothing_gets_a_sentence(served, content, words):
    answer, said = served("POST", "/step", content)
    assert answer.status in (400, 404) and words in said.decode()
    assert served("GET", "/nothing")[0].status == 404


SCENE = """
[mesh]
shape = "box"
size = [0.02, 0.02, 0.02]
cells = [2, 2, 2]
[law]
name = "neo_hookean"
mu = 1000.0
bulk = 3000.0
[body]
density = 1000.0
[[fixed]]
where = {z_max = 0.0}
[solve]
kind = "dynamic"
dt = 0.01
"""


@pytest.mark.ci
def test_the_command_pulls_without_a_page_and_refuses_in_a_sentence(tmp_path, capsys):
    scene = tmp_path / "cube.toml"
    scene.write_text(SCENE)
    assert main(["play", str(scene), "--steps", "5"]) == 0
    said = capsys.readouterr().out
    assert "27 nodes, 5 steps" in said and "per second" in said and "failed" not in said
    # A node with a prescribed motion cannot be pulled.
    driven = SCENE.replace("[solve]", "[[displaced]]\nset = 'z_max'\nby = [0, 0, 0.001]\n[solve]")
    scene.write_text(driven)
    assert main(["play", str(scene), "--steps", "1"]) == 0
    node = int(re.search(r"node (\d+) moved", capsys.readouterr().out)[1])
    assert np.isclose(lj.load_scene(scene).mesh.points[node, 2], 0.01)
    assert main(["play", str(scene), "--steps", "0"]) == 2 and "--steps 0" in capsys.readouterr().err
    assert main(["play", str(scene), "--port", "70000"]) == 2 and "--port 70000" in capsys.readouterr().err
