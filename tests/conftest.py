"""Settings for all tests: 64 bit, no silent rank promotion, and data of other programs where they are present."""

import os

# The two test processes share two cores, so threads of the BLAS would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gc
import io
import json
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

import liverjax as lj
from liverjax.core.versions import versions
from liverjax.mesh.nodal import nodal_volumes
from liverjax.reduced.model import with_all_points
from liverjax.simulation.equations import free_directions

matplotlib.use("Agg")
jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = Path(__file__).parent.parent
#: Results of other programs and measured data that are not part of the project.
SHARED = Path(os.environ.get("LIVERJAX_SHARED", ROOT.parent / "shared"))
# XLA's newer code generation takes two thirds of the compile time; jax 0.11 has no other. A program compiled as one
# part compiles a seventh faster on the one core of a test process.
if "XLA_FLAGS" not in os.environ:
    # A GPU adds in no fixed order by default, so equal runs differ in their last digits. This option fixes the order.
    os.environ["XLA_FLAGS"] = "--xla_gpu_deterministic_ops=true"
    if version("jaxlib").startswith(("0.8.", "0.9.", "0.10.")):
        os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

#: Files that take only seconds. They run first, so that with -x an error shows within half a minute.
QUICK = {
    f"test_{name}"
    for name in (
        "bounds",
        "check",
        "host",
        "house",
        "law_values",
        "laws",
        "material_cards",
        "mesh",
        "mjed",
        "names",
        "raw_torque",
        "rheometer",
        "rheometer_notes",
        "rheometer_tables",
        "stretches",
    )
}
#: Caches are emptied at the beginning of a file if more programs than this are compiled. Each program needs one or two
#: megabytes, and 10 of the 65,530 memory maps that Linux grants a process, or 150 if it is compiled in parts. About 430
#: such programs made jax 0.10.1 crash. Files with few programs keep those that are there.
MANY_PROGRAMS = 400 if "parallel_codegen_split_count=1" in os.environ.get("XLA_FLAGS", "") else 100


def pytest_addoption(parser):
    """Add the option for the verification page."""
    text = "run the tests that have a known answer, slow ones too, and put their rows into a JSON file"
    parser.addoption("--verification", metavar="FILE", type=Path, help=text)


def pytest_collection_modifyitems(config, items):
    """Select the tests. With --verification, only tests with a known solution run; otherwise files with few programs
    first.
    """
    if config.getoption("--verification"):
        items[:] = [item for item in items if "verified" in item.fixturenames]
    items.sort(key=lambda item: item.path.stem not in QUICK)


def pytest_terminal_summary(terminalreporter, config):
    """Write the rows of the passed tests, sorted by their names. Rows of tests that did not run stay as they are."""
    file = config.getoption("--verification")
    if file:
        stats = terminalreporter.stats
        ran = {r.nodeid for kind in ("passed", "failed", "skipped", "error") for r in stats.get(kind, [])}
        passed = stats.get("passed", [])
        rows = [dict(row, test=r.nodeid) for r in passed for name, row in r.user_properties if name == "verified"]
        before = json.loads(file.read_text())["rows"] if file.exists() else []
        made = {row["benchmark"] for row in rows}  # a test may have been renamed
        old = [r for r in before if r["test"] not in ran and r["benchmark"] not in made]
        old = [r for r in old if Path(config.rootpath, r["test"].split("::")[0]).exists()]
        rows = sorted(rows + old, key=lambda row: row["test"])
        content = {"rows": rows, "environment": versions()}
        file.write_text(json.dumps(content, indent=1) + "\n")


@pytest.fixture
def verified(record_property):
    """Return a function that adds a row to the verification page if the test passes.

    The row holds the benchmark, its source, the largest difference [1], the allowed difference and the order.
    """

    def row(benchmark: str, source: str, difference: float, allowed: float, order: float | None = None, **values):
        numbers = {"difference": float(difference), "allowed": float(allowed)}
        numbers |= {name: float(value) for name, value in values.items()}
        order = None if order is None else float(order)
        record_property("verified", {"benchmark": benchmark, "source": source, "order": order} | numbers)

    return row


def pytest_configure(config):
    """Share compiled programs with the other test process and with commands that tests start."""
    config.addinivalue_line("markers", "slow: run by python -m pytest -m slow, not by default")
    config.addinivalue_line("markers", "ci: takes some seconds; run by .ci/run and by -m 'not slow', not by default")
    config.addinivalue_line("markers", "core: each public entry once, for other versions of Python and jax: -m core")
    config.addinivalue_line("markers", "draws: its pictures are drawn; those of other tests are files of one point")
    config.addinivalue_line("markers", "quick_to_compile: few optimisations, where compiling takes longer than running")
    if config.getoption("--verification"):
        config.option.markexpr = ""
    if not hasattr(config, "workerinput"):
        config.compiled = tempfile.mkdtemp()
        os.environ["LIVERJAX_CACHE"] = "off"  # the user's own cache stays as it is
        os.environ["JAX_COMPILATION_CACHE_DIR"] = config.compiled
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"  # found again in a few milliseconds
    # Tracing makes millions of objects that stay in memory. Without this call, Python would scan all of them
    # repeatedly.
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


def pytest_unconfigure(config):
    """Remove the temporary folder."""
    if hasattr(config, "compiled"):
        shutil.rmtree(config.compiled, ignore_errors=True)


#: One entry for each program that was compiled or found on disk since caches were last emptied. Tests that count
#: programs read this list, because a separate listener could not be removed without this one.
COMPILED: list[float] = []


def _count(event: str, seconds: float, **_: object) -> None:
    if event.endswith("backend_compile_duration"):
        COMPILED.append(seconds)


jax.monitoring.register_event_duration_secs_listener(_count)


@pytest.fixture(autouse=True, scope="module")
def _compilation(request):
    quick = any(mark.name == "quick_to_compile" for mark in request.node.iter_markers())
    changed = quick != jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", quick)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(quick))  # for commands that tests start
    if changed or len(COMPILED) > MANY_PROGRAMS:
        jax.clear_caches()
        COMPILED.clear()


@pytest.fixture(autouse=True)
def _strict():
    assert jax.config.jax_enable_x64


def _one_point(_figure: object, file: Path, **_: object) -> None:
    content = io.BytesIO()
    plt.imsave(content, np.zeros((1, 1)), format="png")
    Path(file).write_bytes(content.getvalue())


@pytest.fixture(autouse=True)
def _pictures(request, monkeypatch):
    """Replace the drawing of figures, which takes longer than most fits. One test of each kind of picture draws it."""
    if request.node.get_closest_marker("draws") is None:
        monkeypatch.setattr(matplotlib.figure.Figure, "savefig", _one_point)


@pytest.fixture
def processor() -> None:
    """Run the test on the processor, for features that only the processor supports."""
    if jax.default_backend() != "cpu":
        pytest.skip("programs run on another device than the processor")


@pytest.fixture
def febio() -> Path:
    """Return the folder of FEBio's results."""
    folder = SHARED / "reference" / "febio"
    if not folder.is_dir():
        pytest.skip("results of FEBio are not here")
    return folder


@pytest.fixture
def distorted_box():
    """A small mesh and positions that stretch, shear and rotate every element differently."""
    mesh = lj.shapes.box((1.0, 1.2, 0.8), (2, 2, 2))
    rng = np.random.default_rng(0)
    A = np.eye(3) + 0.25 * rng.standard_normal((3, 3))
    x = np.asarray(mesh.points) @ A.T + 0.04 * rng.standard_normal(mesh.points.shape)
    return mesh, jax.numpy.asarray(x)


@pytest.fixture
def table_2() -> lj.Prony:
    """The viscosity of the chapter's Table 2."""
    return lj.Prony(ratios=jax.numpy.array([0.235, 0.333]), relaxation_times=jax.numpy.array([0.27, 0.03]))


def every_motion(scene):
    """Return one mode (V, 3) for each free degree of freedom of a scene.

    The modes are orthonormal with respect to the lumped volumes of the nodes.
    """
    free = np.asarray(free_directions(scene).mask)
    modes = np.eye(free.size)[np.flatnonzero(free.ravel())].reshape(-1, *free.shape)
    return jax.numpy.asarray(modes / np.sqrt(np.asarray(nodal_volumes(scene.mesh)))[:, None])


def moves_as_full(scene):
    """Return the positions (T, V, 3) [m] of a run, after a comparison with a reduced model of all modes and points."""
    full, model = lj.simulate(scene).check(), with_all_points(scene, every_motion(scene))
    found = lj.simulate_reduced(model, scene)
    assert not np.any(found.status)
    moved = np.abs(full.positions - scene.mesh.points[None]).max()
    # The bound is the solver's tolerance of 1e-8 times a condition number of some thousands.
    assert np.abs(lj.reduced_positions(model, scene, found) - full.positions).max() < 1e-5 * moved
    return full.positions
