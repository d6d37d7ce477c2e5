"""The base class of all physics: one frozen struct of numbers, and a second struct that acts during a step.

A scene has a tuple of physics. Each physics has a memory between steps, and a part that acts during a step:

* `begin(start)` -> memory: its memory at the beginning of a run, any pytree;
* `freeze(memory, step)` -> the acting part, with everything that is constant during the step;
* `advance(memory, acting, end)` -> memory: its memory after an accepted step;
* `check(...)`: refuses numbers that no step can use, with one sentence.

Loads and motions change during a step: they are evaluated at a fraction s of the step (0 at its beginning, 1 at its
end).

There are three kinds of acting parts. The step, its tangent and its energy are sums over these parts and need nothing
else.

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

#: Which blocks of the stiffness to compute: pairs of indices into a list of shape vectors.
Pairs = tuple[tuple[int, int], ...]


class Tied(Protocol):
    """Nodes that move together in a step. A few unknowns give their motion; they are stored in a field of the nodes."""

    def gathered(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """The part of a field (V, 3) along the free motions. For forces it depends on the positions x (V, 3)."""

    def unknown(self, field: jax.Array, x: jax.Array) -> jax.Array:
        """Write the unknowns of the motion to positions x (V, 3) into a field (V, 3).

        `placed` is the inverse of this.
        """

    def placed(self, field: jax.Array, s: Number) -> jax.Array:
        """Positions (V, 3) from a field, at fraction s of the step."""

    def not_given(self, mask: jax.Array, axes: jax.Array | None) -> tuple[jax.Array, jax.Array | None]:
        """The mask (V, 3) with 0 at the nodes whose motion is given, and the free directions (V, 3) of these nodes.

        A direction is the only free direction of a node with a given motion, and 0 at other nodes. None: there is no
        such node.
        """

    def rigid(self, x: jax.Array, velocity: jax.Array, acceleration: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Velocity and acceleration (V, 3) of a rigid motion of the nodes at positions x (V, 3), from those of every
        node by itself."""


class Free(NamedTuple):
    """The directions in which the body can move, as a projection of nodal vectors."""

    mask: jax.Array  # (V, 3) 0 along held or prescribed axes, else 1
    normals: jax.Array | None = None  # (V, 3) unit normals; nodes may not move along them; 0 elsewhere
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
        """The free part of a field that is given as its columns x, y, z (V,)."""
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
    moved: bool = False  # whether the body was just moved to x; if not, it rests at x or x is only a guess


class Step(NamedTuple):
    """The state at the beginning of a step. It is constant during the step."""

    mesh: TetMesh
    x: jax.Array  # (V, 3) [m] positions at the beginning of the step
    k: Number  # number of the step, from 1
    steps: int  # number of steps of the run
    dt: Any  # [s] or None: load steps without time
    inertia: bool  # whether there is inertia: then loads act at once
    tolerance: Any  # of the residual, without derivative
    free: Free
    averaged: bool = False  # whether forces at the beginning and at the end of a step count half each: Newmark's method


class End(NamedTuple):
    """The state at the end of an accepted step."""

    x: jax.Array  # (V, 3) [m]
    F: Matrix  # deformation gradients (E,), or (Q, E) if elements have Q points
    pressure: Any  # (V,) [Pa] of the nodes, or None
    by_end_forces: jax.Array | None = None  # (V, 3) [m/s^2] minus the acceleration by `NodalForce.at_end`


class Solid:
    """An acting part whose stress in an element depends only on the deformation gradient."""

    def stress(self, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress [Pa]."""
        raise TypeError(f"{type(self).__name__} lacks stress(F)")

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """Blocks d2W/dx_i dx_j per reference volume, for shape vectors D [1/m] and pairs (i, j)."""
        raise TypeError(f"{type(self).__name__} lacks blocks(F, D, pairs)")

    def energy(self, F: Matrix) -> jax.Array:
        """Energy density (E,) [Pa]."""
        raise TypeError(f"{type(self).__name__} lacks energy(F)")

    def parts(self) -> tuple[list[tuple[Any, Any]], Matrix | None]:
        """Pairs (weight, law), and a constant second Piola-Kirchhoff stress [Pa]. Their sum is the stress."""
        raise TypeError(f"{type(self).__name__} lacks parts()")


class VolumeStress:
    """An acting part that depends on the volume of elements, with pressures at the nodes."""

    #: Whether pressures depend on the positions at the end of the step: then they are in the mixed system.
    coupled: ClassVar[bool] = True
    #: Whether pressures are unknowns of Newton's method (`liverjax.physics.volumes.mixed`) and not eliminated.
    unknown: ClassVar[bool] = False

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: Guess | None = None) -> jax.Array:
        """Pressures (V,) [Pa] of a step that ends with volume ratios J (E,). A solve for them begins with `guess`."""
        raise TypeError(f"{type(self).__name__} lacks pressure(mesh, J)")

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """First Piola-Kirchhoff stress [Pa] at given pressures (V,)."""
        raise TypeError(f"{type(self).__name__} lacks stress(mesh, pressure, F)")

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Stress and slope at given pressures."""
        raise TypeError(f"{type(self).__name__} lacks scalars(mesh, pressure, F)")

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Energy [J] at volume ratios J (E,), with the pressures that belong to them."""
        raise TypeError(f"{type(self).__name__} lacks energy(mesh, J)")

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Matrix of the pressures [m^3/Pa]. If `positive`, it has no negative eigenvalue."""
        raise TypeError(f"{type(self).__name__} lacks matrix(mesh, J, positive)")

    #: The equation of pressures that flow (`liverjax.physics.darcy.Flow`); None: there is no flow between nodes.
    flow: Any = None


class NodalForce:
    """An acting part with forces at nodes."""

    #: Whether it has a stiffness at every node: then slowly varying motions do not slow down the linear solver.
    everywhere: ClassVar[bool] = False
    #: Whether the force has an energy. A force that follows the body has none, and its stiffness is not symmetric.
    conservative: bool = True
    #: Whether the derivative of the force jumps, for example where contact begins.
    kinked: ClassVar[bool] = False
    #: Whether Newmark's method takes only the force at the end of the step. The force is then doubled, since the mean
    #: of the other forces is half of the sum at both ends.
    at_end: bool = False

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Gradient of the energy (V, 3) [N] at positions x (V, 3) [m], at fraction s of the step."""
        raise TypeError(f"{type(self).__name__} lacks force(mesh, x, s)")

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Energy [J] at the end of the step."""
        raise TypeError(f"{type(self).__name__} lacks energy(mesh, x)")

    def energy_from(self, mesh: TetMesh, x: jax.Array, start: jax.Array) -> jax.Array:
        """An energy [J] at x for a search that begins at `start` (V, 3). Its gradient at `start` is the force there.

        If the force has an energy, this is that energy. Otherwise the part of the force that has no energy keeps its
        value at `start`.
        """
        return self.energy(mesh, x)

    def stiffness(self) -> Block | None:
        """Diagonal blocks: 3 x 3 entries (V,) [N/m], None for an entry that is 0. None: there are no such blocks."""
        return None

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """Stiffness at x of elements between nodes, in addition to `stiffness`; None: there are no such elements."""
        return None

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """`attached` without negative eigenvalues."""
        own = self.attached(mesh, x, s)
        return without_negative(own) if isinstance(own, Attached) else own

    def gives_way(self, mesh: TetMesh, x: jax.Array, s: Number, definite: bool) -> GivesWay | None:
        """The loss of stiffness that an eliminated unknown causes, for example the travel of an obstacle.

        With `definite` it is the loss for `definite` above, without negative eigenvalues. None: there is no such
        unknown.
        """
        return None

    def predicted(self) -> jax.Array | None:
        """Positions (V, 3) [m] that the body would reach without forces, as a guess for Newton; None: no such guess."""
        return None

    def accelerations(self, force: jax.Array, x: jax.Array) -> jax.Array | None:
        """Accelerations (V, 3) [m/s^2] of free nodes at x (V, 3) by a force (V, 3) [N]; None: the part has no mass."""
        return None

    def inertial(self, acceleration: jax.Array) -> jax.Array:
        """Forces (V, 3) [N] of inertia, for a part with mass."""
        raise TypeError(f"{type(self).__name__} lacks inertial(acceleration)")

    def product(self, mesh: TetMesh, x: jax.Array, s: Number, dx: jax.Array) -> jax.Array:
        """Change (V, 3) [N] of a force that is not conservative, for a motion dx (V, 3) [m]."""
        return jax.jvp(lambda x: self.force(mesh, x, s), (x,), (dx,))[1]


class Physics:
    """One physics of a scene: a struct of numbers. The module explains its methods."""

    #: Every physics is a struct, so `dataclasses.replace` takes it.
    __dataclass_fields__: ClassVar[Content]
    #: Name of its table in scene files; `keys` are the keys of this table.
    section: ClassVar[str] = ""
    #: Whether it makes nodes move together. The factorisation cannot treat such nodes.
    ties: ClassVar[bool] = False
    #: Whether it needs the time step `step.dt`. Then a scene without a time step is refused.
    in_time: ClassVar[bool] = False
    #: Whether its forces have an energy. Friction forces have none.
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
        """Refuse a mesh with which it cannot begin; host side. A loaded mesh is not checked: no run begins with it.

        Raises:
            InputError: one sentence that begins with `name`.
        """

    def in_body(self, mesh: TetMesh, law: Any) -> "Physics":
        """The same physics, with the numbers that follow from the law of the body."""
        return self

    def at_beginning(self) -> "Physics":
        """The same physics at the beginning of a run, before anything moves."""
        return self

    def begin(self, start: Start) -> Any:
        """Memory at the beginning of a run; None: this physics has no memory."""
        return None

    @classmethod
    def acts_without_memory(cls) -> bool:
        """Whether `freeze` accepts None as the memory of a body at rest at the beginning of a run."""
        return cls.begin is Physics.begin

    def freeze(self, memory: Any, step: Step) -> Any:
        """The part that acts during a step; None: nothing acts."""
        return None

    def advance(self, memory: Any, acting: Any, end: End) -> Any:
        """Memory after an accepted step."""
        return memory

    def constrain(self, free: Free) -> Free:
        """The free directions without the directions that this physics holds."""
        return free

    def tied(self, step: Step) -> Tied | None:
        """Nodes that move together during a step because of this physics; None: there are none."""
        return None

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Node numbers (n,) and directions (n, 3) along which this physics holds the body against rigid motions."""
        return np.zeros(0, int), np.zeros((0, 3))

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Physics":
        """The same physics on a mesh of richer elements.

        `more` adds the new nodes between nodes (n,) to their numbers.
        """
        return self

    def bulk_modulus(self) -> Any:
        """Bulk modulus [Pa] that replaces the bulk modulus of the law; None: it is not replaced."""
        return None

    def output(self, memory: Any) -> dict[str, jax.Array]:
        """Fields of the vertices (V,) for the result, in addition to positions and reactions."""
        return {}


def diagonal(value: jax.Array) -> Block:
    """Diagonal 3 x 3 blocks with the same value (V,) for every axis."""
    return ((value, None, None), (None, value, None), (None, None, value))
