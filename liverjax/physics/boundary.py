"""Supports, prescribed motions and loads of a body, under one name: `lj.boundary`."""

from liverjax.mesh.nodal import nodal_volumes
from liverjax.mesh.selection import AXES, boundary_triangles, select, surface_of
from liverjax.physics.loads import Traction, follower_forces, follows, nodal_tractions
from liverjax.physics.prescribed import Displaced, Fixed, free_degrees, prescribed

__all__ = [
    "AXES",
    "Displaced",
    "Fixed",
    "Traction",
    "boundary_triangles",
    "follower_forces",
    "follows",
    "free_degrees",
    "nodal_tractions",
    "nodal_volumes",
    "prescribed",
    "select",
    "surface_of",
]
