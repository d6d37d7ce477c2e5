"""The base class of all physics, and the base classes of the force terms of a step.

In this project, "a physics" is one object that adds forces or constraints to a body: a law, viscosity, loads, contact
or a support. Its numbers are stored in an immutable struct. A scene has a tuple of such objects. A physics may have
internal variables, which are passed from step to step in the argument `memory`. In each step, a physics returns a force
term. The force term stores everything that is constant during the step. The main methods are:

* `begin(start)` -> memory: return the internal variables at the beginning of a run (any pytree);
* `freeze(memory, step)`: return the force term of the step;
* `advance(memory, acting, end)` -> memory: return the internal variables after an accepted step with the force term
  `acting`;
* `check(...)`: raise InputError if a number cannot be used in any step.

Loads and prescribed motions change during a step. Methods evaluate these loads and motions at a fraction s of the step
(0 at its beginning, 1 at its end).

There are three classes of force terms. The forces, the tangent and the energy of a step are sums over all force terms.

* `Solid` and `VolumeStress` act in the elements, before assembly. They return stresses and blocks of the stiffness
  matrix.
* `NodalForce` acts at the nodes, after assembly. It returns nodal forces and their stiffness.

A `VolumeStress` has pressures at the nodes. If these pressures are not known in advance, a mixed system of equations
determines positions and pressures together (`liverjax.simulation.mixed_system`). V is the number of nodes (for
pressures the number of vertices), E the number of elements.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, Self

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

#: Pairs (i, j) of nodes of an element, for which stiffness blocks are computed. i and j are indices in a list of the
#: gradients of the shape functions.
Pairs = tuple[tuple[int, int], ...]


class Tied(Protocol):
    """Nodes that move together in a step, for example as a rigid body.

    A few unknowns define the motion of these nodes. A nodal field (V, 3) stores the unknowns in the rows of the nodes.
    """

    @property
    def linear(self) -> bool:
        """Whether the positions of these nodes are a linear function of their unknowns."""

    def gathered(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """Project a nodal field (V, 3) onto the free motions of the nodes.

        If the field contains forces, the positions x (V, 3) are also needed.
        """

    def at(self, x: jax.Array) -> "Tied":
        """Return the same nodes with the directions of their motions at positions x (V, 3)."""

    def turned(self, field: jax.Array, other: Self) -> jax.Array:
        """Return `field` (V, 3), changed such that these nodes move in the directions of motion of `other`.

        `other` are the same nodes at other positions (method `at`). The amplitudes of the motions do not change.
        """

    def unknown(self, field: jax.Array, x: jax.Array) -> jax.Array:
        """Return `field` (V, 3), with the unknowns of these nodes for positions x (V, 3) in the rows of these nodes.

        The method `placed` is the inverse of this method.
        """

    def placed(self, field: jax.Array, s: Number) -> jax.Array:
        """Return `field` (V, 3) with positions at fraction s of the step instead of the unknowns of these nodes."""

    def not_given(self, mask: jax.Array, axes: jax.Array | None) -> tuple[jax.Array, jax.Array | None]:
        """Return `mask` (V, 3), with 0 at nodes with a given motion, and the free directions (V, 3) of these nodes.

        A node with a given motion has at most one free direction. At other nodes, the directions are 0. If no node with
        a given motion has a free direction, None is returned instead of the directions.
        """

    def rigid(self, x: jax.Array, velocity: jax.Array, acceleration: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return velocity and acceleration (V, 3), with the values of a rigid motion at these nodes.

        The arguments `velocity` and `acceleration` (V, 3) were computed for each node separately. x (V, 3) are
        positions.
        """


class Free(NamedTuple):
    """The directions in which the nodes can move. The method `vectors` projects nodal vectors onto these directions."""

    mask: jax.Array  # (V, 3): 0 along fixed or prescribed axes, else 1
    normals: jax.Array | None = None  # (V, 3) unit normals along which nodes cannot move; 0 at other nodes
    tied: tuple[Tied, ...] = ()  # nodes that move together

    def vectors(self, field: jax.Array, x: jax.Array | None = None) -> jax.Array:
        """Project a nodal field (V, 3) onto the free directions.

        If nodes move together and the field contains forces, the positions x (V, 3) are also needed.
        """
        field = self.mask * field
        if self.normals is not None:
            field = field - jnp.sum(self.normals * field, axis=1, keepdims=True) * self.normals
        for nodes in self.tied:
            field = nodes.gathered(field, x)
        return field

    def columns(self, columns: Sequence[jax.Array]) -> list[jax.Array]:
        """Project a nodal field, given as its three columns (V,) of x, y and z components, onto the free directions."""
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
    x: jax.Array  # (V, 3) [m] positions
    free: Free
    force: Callable[[], jax.Array]  # (V, 3) [N] nodal forces at x, without inertia
    moved: bool = False  # True: the body was just moved to x. False: it is at rest at x, or x is only a guess
    given: jax.Array | None = None  # (V, 3) [m/s^2] acceleration in directions with a given motion; None: it is 0


class Step(NamedTuple):
    """The state at the beginning of a step. This state is constant during the step."""

    mesh: TetMesh
    x: jax.Array  # (V, 3) [m] positions at the beginning of the step
    k: Number  # number of the step; the first step is 1
    steps: int  # number of steps of the run
    dt: Any  # [s] time step; None for load steps without time
    inertia: bool  # whether the run has inertia; if true, the full loads act from the first step on
    tolerance: Any  # tolerance of the residual, a constant in derivatives
    free: Free
    averaged: bool = False  # True (Newmark): the step uses the mean of the forces at its beginning and end
    #: (V, 3) [m/s^2] acceleration at the end of the step where the motion is given (Newmark only); None: it is 0
    given: jax.Array | None = None


class End(NamedTuple):
    """The state at the end of an accepted step."""

    x: jax.Array  # (V, 3) [m] positions
    F: Matrix  # deformation gradients (E,), or (Q, E) with Q integration points per element
    pressure: Any  # (V,) [Pa] at the nodes, or None
    by_end_forces: jax.Array | None = None  # (V, 3) [m/s^2] acceleration due to force terms with `at_end`, times -1


class Solid:
    """A force term of one step whose stress in an element depends only on the deformation gradient."""

    def stress(self, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress [Pa]."""
        raise TypeError(f"{type(self).__name__} must define stress(F)")

    def blocks(self, F: Matrix, D: list[Vector], pairs: Pairs) -> list[Matrix]:
        """Return the stiffness blocks d2W/dx_i dx_j of the energy W per reference volume, for pairs (i, j) of nodes.

        D [1/m] are the gradients of the shape functions.
        """
        raise TypeError(f"{type(self).__name__} must define blocks(F, D, pairs)")

    def energy(self, F: Matrix) -> jax.Array:
        """Return the energy density (E,) [Pa]."""
        raise TypeError(f"{type(self).__name__} must define energy(F)")

    def parts(self) -> tuple[list[tuple[Any, Any]], Matrix | None]:
        """Return pairs (weight, law), and a constant second Piola-Kirchhoff stress [Pa] or None.

        The stress of this term is the weighted sum of the stresses of the laws, plus the constant stress.
        """
        raise TypeError(f"{type(self).__name__} must define parts()")


class VolumeStress:
    """A force term of one step whose stress depends on the volume ratio of elements and on pressures at nodes."""

    #: Whether the pressures are a function of the positions at the end of the step. If true, the mixed system contains
    #: the pressures.
    coupled: ClassVar[bool] = True
    #: Whether the pressures are unknowns of Newton's method (`liverjax.physics.volumes.mixed`). If false, they are
    #: eliminated or known.
    unknown: ClassVar[bool] = False

    def pressure(self, mesh: TetMesh, J: jax.Array, guess: Guess | None = None) -> jax.Array:
        """Return the pressures (V,) [Pa] at the end of a step with volume ratios J (E,).

        If the pressures are found by iterations, the iterations start at `guess`.
        """
        raise TypeError(f"{type(self).__name__} must define pressure(mesh, J)")

    def stress(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Matrix:
        """Return the first Piola-Kirchhoff stress [Pa] at given pressures (V,)."""
        raise TypeError(f"{type(self).__name__} must define stress(mesh, pressure, F)")

    def scalars(self, mesh: TetMesh, pressure: jax.Array, F: Matrix) -> Scalars:
        """Return the first and second derivative of the energy density with respect to J, the volume ratio."""
        raise TypeError(f"{type(self).__name__} must define scalars(mesh, pressure, F)")

    def energy(self, mesh: TetMesh, J: jax.Array) -> jax.Array:
        """Return the energy [J] at volume ratios J (E,), with the pressures that belong to these volume ratios."""
        raise TypeError(f"{type(self).__name__} must define energy(mesh, J)")

    def matrix(self, mesh: TetMesh, J: jax.Array, positive: bool) -> BlockMatrix:
        """Return the matrix [m^3/Pa] of the pressure equation, without negative eigenvalues if `positive` is true."""
        raise TypeError(f"{type(self).__name__} must define matrix(mesh, J, positive)")

    #: The pressure equation of a flowing fluid (`liverjax.physics.darcy.Flow`). None: no fluid flows between nodes.
    flow: Any = None


class NodalForce:
    """A force term of one step with forces at nodes."""

    #: Whether the term has a stiffness at every node, equal for all axes. If this stiffness is large, the
    #: preconditioner uses no coarse space.
    everywhere: ClassVar[bool] = False
    #: Whether the force has an energy. A follower force has no energy, and its stiffness is not symmetric.
    conservative: bool = True
    #: Whether the derivative of the force jumps, for example where contact begins.
    kinked: ClassVar[bool] = False
    #: Whether Newmark's method uses only the force at the end of the step. This force is doubled, since Newmark's
    #: method multiplies the sum of the forces at the beginning and at the end of the step by 1/2.
    at_end: bool = False

    def force(self, mesh: TetMesh, x: jax.Array, s: Number) -> jax.Array:
        """Return the gradient of the energy (V, 3) [N]: nodal forces at positions x (V, 3) and fraction s of a step."""
        raise TypeError(f"{type(self).__name__} must define force(mesh, x, s)")

    def energy(self, mesh: TetMesh, x: jax.Array) -> jax.Array:
        """Return the energy [J] at the end of the step."""
        raise TypeError(f"{type(self).__name__} must define energy(mesh, x)")

    def energy_from(self, mesh: TetMesh, x: jax.Array, start: jax.Array) -> jax.Array:
        """Return an energy [J] at positions x, for a minimisation that begins at the positions `start` (V, 3).

        The gradient of this energy at `start` is the force at `start`. If the force has an energy, this energy is
        returned. Otherwise the non-conservative part of the force keeps its value at `start`.
        """
        return self.energy(mesh, x)

    def stiffness(self) -> Block | None:
        """Return the stiffness of each node: 3 x 3 entries (V,) [N/m], with None for entries that are 0.

        Returns None if the term has no such stiffness.
        """
        return None

    def attached(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """Return the stiffness, at positions x, of additional elements that connect nodes (for example membranes).

        The result does not contain the stiffness of single nodes (method `stiffness`). Returns None if the term has no
        such elements.
        """
        return None

    def definite(self, mesh: TetMesh, x: jax.Array, s: Number) -> Between | None:
        """Return the same stiffness as `attached`, with negative eigenvalues removed."""
        own = self.attached(mesh, x, s)
        return without_negative(own) if isinstance(own, Attached) else own

    def gives_way(self, mesh: TetMesh, x: jax.Array, s: Number, definite: bool) -> GivesWay | None:
        """Return the loss of stiffness due to an eliminated unknown, for example the displacement of an obstacle.

        If the argument `definite` is true, this loss is subtracted from the result of the method `definite`, otherwise
        from the result of the method `attached`. Returns None if there is no such unknown.
        """
        return None

    def predicted(self) -> jax.Array | None:
        """Return the positions (V, 3) [m] that the body would reach without forces.

        Newton's method can start at these positions.

        Returns None if these positions are unknown.
        """
        return None

    def accelerations(self, force: jax.Array, x: jax.Array) -> jax.Array | None:
        """Return the accelerations (V, 3) [m/s^2] of free nodes at positions x due to forces (V, 3) [N].

        Returns None if the term has no mass.
        """
        return None

    def inertial(self, acceleration: jax.Array) -> jax.Array:
        """Return the inertia forces (V, 3) [N] for accelerations (V, 3) [m/s^2], if the term has mass."""
        raise TypeError(f"{type(self).__name__} must define inertial(acceleration)")

    def product(self, mesh: TetMesh, x: jax.Array, s: Number, dx: jax.Array) -> jax.Array:
        """Return the change (V, 3) [N] of a non-conservative force due to a small displacement dx (V, 3) [m]."""
        return jax.jvp(lambda x: self.force(mesh, x, s), (x,), (dx,))[1]


class Physics:
    """Base class of all physics objects (supports, loads, contact, …), which are structs of numbers.

    The docstring of the module explains the main methods.
    """

    #: All subclasses are structs, so `dataclasses.replace` can be used with their objects.
    __dataclass_fields__: ClassVar[Content]
    #: Name of the table in scene files. `keys` are the keys of this table.
    section: ClassVar[str] = ""
    #: Whether nodes move together because of this physics. If true, linear_solver = 'direct' cannot be used.
    ties: ClassVar[bool] = False
    #: Whether the physics needs the time step `step.dt`. If true, a scene without a time step raises InputError.
    in_time: ClassVar[bool] = False
    #: Whether the forces have an energy. Friction forces have no energy.
    conservative: ClassVar[bool] = True
    keys: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def read(cls, mesh: TetMesh, table: dict[str, object], name: str) -> "Physics":
        """Read the physics from a table of a scene file.

        Raises:
            InputError: the table contains values that cannot be used.
        """
        raise TypeError(f"{cls.__name__} has no table in scene files")

    def check(self, mesh: TetMesh, name: str) -> None:
        """Check the numbers of this physics.

        Raises:
            InputError: a number cannot be used in any step. The message begins with `name`.
        """

    def check_place(self, mesh: TetMesh, name: str) -> None:
        """Check that a run can begin with this mesh in its reference shape.

        This method is not called if the mesh is in its loaded shape.

        Raises:
            InputError: the run cannot begin (e.g. an obstacle is inside the body). The message begins with `name`.
        """

    def in_body(self, mesh: TetMesh, law: Any) -> "Physics":
        """Return this physics, with values from the law of the body for the numbers that the user did not give."""
        return self

    def at_beginning(self) -> "Physics":
        """Return the same physics in its state at the beginning of a run, before anything moves."""
        return self

    def begin(self, start: Start) -> Any:
        """Return the internal variables at the beginning of a run, or None if there are no internal variables."""
        return None

    @classmethod
    def acts_without_memory(cls) -> bool:
        """Return whether `freeze` accepts None as `memory`, for a body at rest at the beginning of a run."""
        return cls.begin is Physics.begin

    def freeze(self, memory: Any, step: Step) -> Any:
        """Return the force term of a step, or None if this physics adds no force."""
        return None

    def advance(self, memory: Any, acting: Any, end: End) -> Any:
        """Return the internal variables after an accepted step with the force term `acting`."""
        return memory

    def constrain(self, free: Free) -> Free:
        """Return the free directions without the directions that this physics constrains."""
        return free

    def tied(self, step: Step) -> Tied | None:
        """Return the nodes that move together in a step because of this physics, or None if there are no such nodes."""
        return None

    def holds(self, mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return n node numbers (n,) and the directions (n, 3) in which this physics constrains these nodes.

        If each of n constraints contains m nodes, the shapes are (n, m) and (n, m, 3). In this case, each constraint
        fixes the sum of m displacements: one of each node along the given direction.
        """
        return np.zeros(0, int), np.zeros((0, 3))

    def pulls_single_nodes(self) -> bool:
        """Return whether forces act at single nodes, not on an area.

        In this case, the displacements of these nodes depend on the size of the elements.
        """
        return False

    def enriched(self, mesh: TetMesh, more: Callable[[Indices], Indices]) -> "Physics":
        """Return the same physics on a mesh with elements of higher order.

        The function `more` takes n node numbers (n,) and returns them, followed by the numbers of the new nodes between
        these nodes.
        """
        return self

    def bulk_modulus(self) -> Any:
        """Return a bulk modulus [Pa] that replaces the bulk modulus of the law, or None if it is not replaced."""
        return None

    def output(self, memory: Any) -> dict[str, jax.Array]:
        """Return additional fields of the result by name, one value per vertex (V,), for example a fluid pressure."""
        return {}


def diagonal(value: jax.Array) -> Block:
    """Return 3 x 3 blocks that are diagonal: `value` (V,) on the diagonal, and None (zero) elsewhere."""
    return ((value, None, None), (None, value, None), (None, None, value))
