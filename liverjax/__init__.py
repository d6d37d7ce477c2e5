"""liverjax: soft-tissue mechanics as one differentiable JAX program.

Importing turns on JAX's 64-bit mode unless the environment sets ``JAX_ENABLE_X64``.
"""

import os

import jax

if jax.__version__ in ("0.10.2", "0.11.0"):
    raise ImportError(
        f"jax {jax.__version__} silently miscompiles element loops on CPU: install another release, "
        "e.g. pip install 'jax!=0.10.2,!=0.11.0'"
    )
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)

from liverjax import boundary, laws, mjed, reference, shapes, viscosity
from liverjax.batch import Batch, simulate_batch
from liverjax.boundary import Displaced, Fixed, Traction
from liverjax.errors import InputError
from liverjax.gradients import Gradient, value_and_gradient
from liverjax.laws import Law
from liverjax.mesh import TetMesh, check_mesh, read_mesh, tet_mesh, write_mesh
from liverjax.porosity import Porosity
from liverjax.regions import Region
from liverjax.scene import Body, Scene, Solve, with_parameters
from liverjax.scene_checks import check_scene
from liverjax.scene_file import load_scene
from liverjax.simulation import Result, simulate
from liverjax.struct import param, static, struct
from liverjax.viscosity import Prony

__version__ = "0.1.0"

__all__ = [
    "Batch",
    "Body",
    "Displaced",
    "Fixed",
    "Gradient",
    "InputError",
    "Law",
    "Porosity",
    "Prony",
    "Region",
    "Result",
    "Scene",
    "Solve",
    "TetMesh",
    "Traction",
    "boundary",
    "check_mesh",
    "check_scene",
    "laws",
    "load_scene",
    "mjed",
    "param",
    "read_mesh",
    "reference",
    "shapes",
    "simulate",
    "simulate_batch",
    "static",
    "struct",
    "tet_mesh",
    "value_and_gradient",
    "viscosity",
    "with_parameters",
    "write_mesh",
]
