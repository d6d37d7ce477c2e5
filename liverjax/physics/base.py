"""The base of every physics: one frozen struct of numbers, and a second struct that acts during a step.

A scene has a tuple of physics. Each has a memory between steps, and parts that act during a step:

* `begin(start)` -> memory: its memory at the beginning of a run, any pytree;
* `freeze(memory, step)` -> the acting part, with everything that is constant during the step;
* `advance(memory, acting, end)` -> memory: after an accepted step;
* `check(...)`: refuses numbers that no step can use, with one sentence.

Loads and motions change during a step: they are evaluated at part s of it, 0 at its beginning and 1 at its end.

The acting parts are of three kinds. Step, tangent and energy are sums over them and know nothing else.

* `Solid` and `VolumeStress` act in elements, before assembly: stress and blocks of the stiffness.
* `NodalForce` acts at nodes, after assembly: forces and blocks of the diagonal.

A `VolumeStress` has pressures at the nodes. The mixed system of positions and pressures solves for them
(`liverjax.simulation.mixed_system`).
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core.struct import Content, Indices, Number
from liverjax.laws.terms.invariant_terms import Scalars
from liverjax.mesh.tetrahedra import TetMesh
from liverjax.physics.darcy import Guess
from liverjax.solvers.attached import Attached, Between, GivesWay
from liverjax.solvers.attached import definite as without_negative
from liverjax.solvers.block_matrix import Block, BlockMatrix
from liverjax.tensors.matrices import Matrix, Vector

#: Blocks of the stiffness to compute, as pairs of indices into a list of shape vectors.
Pairs = tuple[tuple[int, int], ...]


class Tied(Protocol):
    """Nodes that move together in a step. A few numbers give their motion; these are stored in a field of the nodes."""

    def gathered(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """The part of a field (V, 3) along the free motions. For forces it depends on the positions x (V, 3)."""

    def unknown(self, field: jax.Array, x: jax.Array) -> jax.Array:
        """Write the numbers of the motion to positions x (V, 3) into a field (V, 3). `placed` inverts this."""

    def placed(self, field: jax.Array, s: Number) -> jax.Array:
        """Positions (V, 3) from a field, at part s of the step."""

    def not_given(self, mask: jax.Array, axes: jax.Array | None) -> tuple[jax.Array, jax.Array | None]:
        """Where motion is not given: the mask (V, 3) with 0 at nodes whose motion is, and (V, 3) the only direction
        that such nodes have free, 0 elsewhere; None: there is none."""


class Free(NamedTuple):
    """Where the body can move: a projection of nodal vectors onto the free directions."""

    mask: jax.Array  # (V, 3) 0 along the axes that are held or prescribed
    normals: jax.Array | None = None  # (V, 3) unit normals that nodes may not move along, 0 elsewhere
    tied: tuple[Tied, ...] = ()  # nodes that move together

    def vectors(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """The free part of a field (V, 3). Forces need the positions x (V, 3) if nodes move together."""
        field = self.mask * field
        if self.normals is not None:
            field = field - jnp.sum(self.normals * field, axis=1, keepdims=True) * self.normals
        for nodes in self.tied:
            field = nodes.gathered(field, x)
        return field

    def columns(self, columns: Sequence[jax.Array]) -> list[jax.Array]:
        """The free part of a field given by its columns x, y, z (V,)."""
        if self.tied:
            return list(self.vectors(jnp.stack(columns, axis=-1)).T)
        masked = [m * c for m, c in zip(self.mask.T, columns, strict=True)]
        if self.normals is None:
            return masked
        n = self.normals.T
        along = n[0] * masked[0] + n[1] * masked[1] + n[2] * masked[2]
        return [c - along * k for c, k in zip(masked, n, strict=True)]


class Start(NamedTuple):
    """The state at the beginning of a run."""

    mesh: TetMesh
    x: jax.Array  # (V, 3) [m]
    free: Free
    force: Callable[[], jax.Array]  # (V, 3) [N] forces of the nodes at x, without inertia
    moved: bool = False  # whether the body was brought to x at this moment; if not, x is at rest or only a guess


class Step(NamedTuple):
    """The state at the beginning of a step; constant during it."""

    mesh: TetMesh
    x: jax.Array  # (V, 3) [m] at its beginning
    k: Number  # its number, from 1
    steps: int  # of the run
    dt: Any  # [s] or None: load steps without time
    inertia: bool  # whether there is inertia: then loads act at once
    tolerance: Any  # of the residual, without derivative
    free: Free


class End(NamedTuple):
    """The state at the end of an accepted step."""

    x: jax.Array  # (V, 3) [m]
    F: Matrix  # deformation gradients (E,), or (Q, E) where elements have Q points
    pressure: Any  # (V,) [Pa] of the nodes, or None


class Solid:
    """A part that acts in elements and depends on the deformation gradient only."""

    def stress(self, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress [Pa]."""
        raise TypeError(f"{type(self).__name__} lacks stress(F)")

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """d2W/dx_i dx_j per reference volume for shape vectors D [1/m]."""
        raise TypeError(f"{type(self).__name__} lacks blocks(F, D, pairs)")

    def energy(self, F: Matrix) -> jax.Array:
        """Energy density (E,) [Pa]."""
        raise TypeError(f"{type(self).__name__} lacks energy(F)")

    def parts(self) -> tuple[list[tuple[Any, Any]], Matrix | None]:
        """Weighted laws, and a constant second Piola-Kirchhoff stress [Pa], that add up to the stress."""
        raise TypeError(f"{type(self).__name__} lacks parts()")


class VolumeStress:
    """A part that acts on the volume of elements, with pressures at the nodes."""

    #: Whether pressures depend on the end of the step: then they are unknowns of the mixed system.
    coupled: ClassVar[bool] = True
    #: Whether pressures are unknowns of Newton's method (`liverjax.physics.volumes.mixed`), not eliminated.
    unknown: ClassVar[bool] = False

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: Guess | None = None) -> jax.Array:
        """Pressures (V,) [Pa] of a step that ends with volume ratios J (E,); `guess` to begin a solve with."""
        raise TypeError(f"{type(self).__name__} lacks pressure(mesh, J)")

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress [Pa] at given pressures (V,)."""
        raise TypeError(f"{type(self).__name__} lacks stress(mesh, pressure, F)")

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Stress and slope at given pressures."""
        raise TypeError(f"{type(self).__name__} lacks scalars(mesh, pressure, F)")

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy [J] at volume ratios J (E,), with the pressures in balance."""
        raise TypeError(f"{type(self).__name__} lacks energy(mesh, J)")

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Matrix of the pressures [m^3/Pa]; `positive`: with no negative eigenvalue."""
        raise TypeError(f"{type(self).__name__} lacks matrix(mesh, J, positive)")

    #: The equation of pressures that flow (`liverjax.physics.darcy.Flow`); None: there is no flow between nodes.
    flow: Any = None


class NodalForce:
    """A part that acts at nodes."""

    #: Whether it acts on every node: then slow motions do not slow down the linear solver.
    everywhere: ClassVar[bool] = False
    #: Whether the force has an energy; one that follows the body has none, and its stiffness is not symmetric.
    conservative: bool = True
    #: Whether the force has kinks, as at the beginning of contact.
    kinked: ClassVar[bool] = False

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Gradient of the energy (V, 3) [N] at positions x (V, 3) [m], at part s of the step."""
        raise TypeError(f"{type(self).__name__} lacks force(mesh, x, s)")

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Energy [J] at the end of the step."""
        raise TypeError(f"{type(self).__name__} lacks energy(mesh, x)")

    def energy_from(self, mesh: TetMesh, x: jax.Array, start: jax.Array) -> jax.Array:
        """An energy [J] at x whose gradient at `start` (V, 3) is the force there, for a search that begins there.

        It is the energy itself if the force has one. Otherwise the part without an energy keeps its value at `start`.
        """
        return self.energy(mesh, x)

    def stiffness(self) -> Block | None:
        """Diagonal blocks 3 x 3 of (V,) [N/m], with None for entries that are 0; None: the force is constant."""
        return None

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """Stiffness at x of further elements between nodes, added to `stiffness`; None: there are none."""
        return None

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """`attached` without negative eigenvalues."""
        own = self.attached(mesh, x, s)
        return without_negative(own) if isinstance(own, Attached) else own

    def gives_way(self, mesh: TetMesh, x: jax.Array, s: Number, definite: bool) -> GivesWay | None:
        """The loss of stiffness by an unknown that follows the motion, such as an obstacle's travel (`definite`: that
        of the form without negative eigenvalues); None: there is no such unknown.
        """
        return None

    def predicted(self) -> jax.Array | None:
        """Positions (V, 3) [m] that the body would reach without forces, Newton's first guess; None: it stays."""
        return None

    def product(self, mesh: TetMesh, x: jax.Array, s: Number, dx: jax.Array) -> jax.Array:
        """Change (V, 3) [N] of a force that is not conservative, with a motion dx (V, 3) [m]."""
        return jax.jvp(lambda x: self.force(mesh, x, s), (x,), (dx,))[1]


class Physics:
    """One physics of a scene: a struct of numbers; see the module."""

    #: Every physics is a struct, so `dataclasses.replace` takes it.
    __dataclass_fields__: ClassVar[Content]
    #: Table of the scene file that it is read from, and the keys of that table.
    section: ClassVar[str] = ""
    #: Whether it makes nodes move together: the factorisation cannot treat them.
    ties: ClassVar[bool] = False
    #: Whether it needs the time step, `step.dt`: a scene without one is then refused.
    in_time: ClassVar[bool] = False
    #: Whether its forces have an energy; those of friction have none.
    conservative: ClassVar[bool] = True
    keys: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def read(cls, mesh: TetMesh, table: dict[str, object], name: str) -> "Physics":
        """Read the physics from a table of a scene file.

        Raises:
            InputError: values that cannot be used.
        """
        raise TypeError(f"{cls.__name__} has no table in scene files")

    def check(self, mesh: TetMesh, name: str) -> None:
        """Refuse numbers that no step can use; host side.

        Raises:
            InputError: one sentence that begins with `name`.
        """

    def check_place(self, mesh: TetMesh, name: str) -> None:
        """Refuse a mesh that it cannot begin with; host side. A loaded mesh is not checked: no run begins there.

        Raises:
            InputError: one sentence that begins with `name`.
        """

    def in_body(self, mesh: TetMesh, law: Any) -> "Physics":
        """The same physics with the numbers that follow from this law."""
        return self

    def at_beginning(self) -> "Physics":
        """The same physics at the beginning of a run, before anything moves."""
        return self

    def begin(self, start: Start) -> Any:
        """Memory at the beginning of a run; None: it remembers nothing."""
        return None

    @classmethod
    def acts_without_memory(cls) -> bool:
        """Whether `freeze` takes None for the memory of a body at rest, at the beginning of a run."""
        return cls.begin is Physics.begin

    def freeze(self, memory: Any, step: Step) -> Any:
        """The part that acts during a step; None: nothing acts."""
        return None

    def advance(self, memory: Any, acting: Any, end: End) -> Any:
        """Memory after an accepted step."""
        return memory

    def constrain(self, free: Free) -> Free:
        """The free directions, without those that this physics takes away."""
        return free

    def tied(self, step: Step) -> Tied | None:
        """Nodes that this physics makes move together during a step."""
        return None

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Node numbers (n,) and directions (n, 3) along which the body is held against rigid motion."""
        return np.zeros(0, int), np.zeros((0, 3))

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Physics":
        """The same physics on a mesh of richer elements: `more` adds the nodes between given node numbers (n,)."""
        return self

    def bulk_modulus(self) -> Any:
        """Bulk modulus [Pa] that acts in place of the law's; None: the law's acts."""
        return None

    def output(self, memory: Any) -> dict[str, jax.Array]:
        """Further fields of the vertices (V,) for the result, besides positions and reactions."""
        return {}


def diagonal(value: jax.Array) -> Block:
    """Blocks of a value (V,) along every axis."""
    return ((value, None, None), (None, value, None), (None, None, value))
