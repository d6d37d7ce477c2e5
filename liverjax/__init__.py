"""liverjax: soft-tissue mechanics as one differentiable JAX program.

The import turns on JAX's 64-bit mode and matrix products with full float32 precision. The environment variables
``JAX_ENABLE_X64`` and ``JAX_DEFAULT_MATMUL_PRECISION`` override these two settings.
"""

import os
from types import ModuleType

import jax

if jax.__version__ in ("0.10.2", "0.11.0"):
    raise ImportError(
        f"jax {jax.__version__} compiles element loops wrongly on CPUs, without an error: install another release, "
        "e.g. pip install 'jax!=0.10.2,!=0.11.0'"
    )
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)
if "JAX_DEFAULT_MATMUL_PRECISION" not in os.environ:
    # By default, a GPU rounds float32 factors of a matrix product to 11 bits. This rounding caused errors of up to 6 %
    # in the results of quadratic elements.
    jax.config.update("jax_default_matmul_precision", "highest")
if len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)) == 1:
    # On one core, JAX would have only one thread. A direct solve runs outside the compiled program and would wait for
    # this thread. So JAX gets two threads.
    os.environ.setdefault("NPROC", "2")

from liverjax import laws
from liverjax.core import addresses
from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.elements import mjed, reference
from liverjax.laws import Law
from liverjax.mesh import shapes
from liverjax.mesh.files import read_mesh, write_mesh
from liverjax.mesh.promotion import quadratic
from liverjax.mesh.refinement import refined, rim
from liverjax.mesh.tetrahedra import TetMesh, check_mesh, tet_mesh
from liverjax.physics import boundary, viscosity
from liverjax.physics.boundary import Displaced, Fixed, Traction
from liverjax.physics.contact.obstacle import Obstacle
from liverjax.physics.porosity import Porosity
from liverjax.physics.viscosity import Prony
from liverjax.reduced.bias import reduced_bias
from liverjax.reduced.estimate import reduced_error
from liverjax.reduced.files import load_reduced, save_reduced
from liverjax.reduced.model import ReducedModel, reduced_identity
from liverjax.reduced.run import ReducedResult, reduced_positions, reduced_pressure, simulate_reduced, stated_error
from liverjax.reduced.separated import SeparatedModel, separate, separated_displacement
from liverjax.reduced.training import reduce_scene
from liverjax.scenes.regions import Region
from liverjax.scenes.scene import Body, Scene, Solve, with_parameters
from liverjax.scenes.scene_checks import check_scene
from liverjax.scenes.scene_file import load_scene
from liverjax.scenes.springpots import SpringpotSeries
from liverjax.simulation.batch import Batch, simulate_batch
from liverjax.simulation.gradients import Gradient, value_and_gradient
from liverjax.simulation.obstacle_forces import obstacle_forces
from liverjax.simulation.run import Result, simulate, unloaded
from liverjax.waves.harmonic import Harmonic, harmonic
from liverjax.waves.mesh_error import harmonic_errors, harmonic_mesh_error

__version__ = "0.1.0"

__all__ = [
    "Batch",
    "Body",
    "Displaced",
    "Fixed",
    "Gradient",
    "Harmonic",
    "InputError",
    "Law",
    "Obstacle",
    "Porosity",
    "Prony",
    "ReducedModel",
    "ReducedResult",
    "Region",
    "Result",
    "Scene",
    "SeparatedModel",
    "Solve",
    "SpringpotSeries",
    "TetMesh",
    "Traction",
    "boundary",
    "check_mesh",
    "check_scene",
    "harmonic",
    "harmonic_errors",
    "harmonic_mesh_error",
    "laws",
    "load_reduced",
    "load_scene",
    "mjed",
    "obstacle_forces",
    "param",
    "quadratic",
    "read_mesh",
    "reduce_scene",
    "reduced_bias",
    "reduced_error",
    "reduced_identity",
    "reduced_positions",
    "reduced_pressure",
    "reference",
    "refined",
    "rim",
    "save_reduced",
    "separate",
    "separated_displacement",
    "shapes",
    "simulate",
    "simulate_batch",
    "simulate_reduced",
    "stated_error",
    "static",
    "struct",
    "tet_mesh",
    "unloaded",
    "value_and_gradient",
    "viscosity",
    "with_parameters",
    "write_mesh",
]

addresses.keep_loaded("liverjax")


def __getattr__(name: str) -> ModuleType:
    return addresses.moved_module("liverjax", name)
