"""Many runs of one scene with different parameters, in one compiled program on all devices of the process.

Each run of the batch has one parameter set. On a CPU each device does one run after another. Simultaneous runs (vmap)
would be slower on a CPU, because every loop would wait for the slowest run. On a GPU each device does all of its runs
simultaneously.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from liverjax.core.errors import InputError
from liverjax.core.struct import param, static, struct
from liverjax.scenes.checks.choices import check_choices
from liverjax.scenes.checks.numbers import check_bounds
from liverjax.scenes.scene import Scene, with_parameters
from liverjax.scenes.scene_checks import check_before_run
from liverjax.simulation import automatic
from liverjax.simulation.run import Result, simulate, unloaded

STRATEGIES = ("map", "vmap")


@struct
class Batch:
    """Results of N runs with T steps each. `result.status` has the shape (N, T). A failed run does not affect other
    runs."""

    result: Result = param("1", "every field with a leading axis of N runs")
    reference: jax.Array | None = param(
        "m", 'reference shapes (N, V, 3) of the runs, if the mesh of the scene is "loaded"', default=None
    )
    strategy: str = static(
        default="map", about="map: one run after another per device; vmap: all runs of a device at once"
    )
    devices: int = static(default=1, about="number of devices that shared the runs")


def strategy_for(platform: str) -> str:
    """Return the fastest strategy on a platform: "map" on a CPU, "vmap" on other platforms."""
    return "map" if platform == "cpu" else "vmap"


def simulate_batch(
    scene: Scene, parameters: dict[str, Any], strategy: str | None = None, devices: list | None = None
) -> Batch:
    """Run a scene once for each set of values in `parameters`. This function may be jitted and differentiated.

    Args:
        scene: `Scene`.
        parameters: dotted names (see `with_parameters`) -> values with a leading axis of N parameter sets.
        strategy: "map" or "vmap"; None: the fastest strategy on the platform (`strategy_for`).
        devices: devices that share the runs; None: all devices of the process.

    Raises:
        InputError: `strategy` is unknown; there are no parameters; two parameters have different numbers of values; the
            scene has no number with one of the names; "vmap" is used on a CPU although `robust` is not "off"; or
            `simulate` would raise InputError for a parameter set (the message then begins with the number of this set).
    """
    devices = jax.local_devices() if devices is None else devices
    strategy = strategy_for(devices[0].platform) if strategy is None else strategy
    if strategy not in STRATEGIES:
        raise InputError(f"strategy = {strategy!r} is not known: use {' or '.join(STRATEGIES)}")
    if strategy == "vmap" and scene.solve.robust != "off" and devices[0].platform == "cpu":
        raise InputError(
            f"strategy = 'vmap' with robust = {scene.solve.robust!r} takes minutes to compile on a CPU: use "
            "strategy = 'map'"
        )
    parameters = {name: jnp.asarray(value, float) for name, value in parameters.items()}
    lanes = _lanes(parameters)
    scene = automatic.with_solver(scene, _checked_lanes(scene, parameters))

    def part(scene, values):
        def run(values):
            own = with_parameters(scene, values)
            if own.points_are != "loaded":
                return simulate(own), None
            own = unloaded(own).scene
            return simulate(own), own.mesh.points

        return jax.lax.map(run, values) if strategy == "map" else jax.vmap(run)(values)

    number = min(len(devices), lanes)
    if number > 1 or devices[0] != jax.local_devices()[0]:
        # The last parameter set is repeated until all devices have the same number of runs.
        fill = -lanes % number
        parameters = {n: jnp.concatenate([v, jnp.repeat(v[-1:], fill, axis=0)]) for n, v in parameters.items()}
        spread = PartitionSpec("lane")
        mesh = Mesh(np.array(devices[:number]), ("lane",))
        specs = (PartitionSpec(), spread)
        part = jax.shard_map(part, mesh=mesh, in_specs=specs, out_specs=spread, check_vma=False)
    found = part(scene, parameters)
    result, reference = jax.tree.map(lambda a: a[:lanes], found)
    return Batch(result=result, reference=reference, strategy=strategy, devices=number)


def _lanes(parameters: dict[str, jax.Array]) -> int:
    if not parameters:
        raise InputError("a batch needs parameters: give e.g. {'law.mu': [700.0, 800.0]}")
    lengths = {name: value.shape[0] if value.ndim else None for name, value in parameters.items()}
    first = next(iter(lengths))
    for name, length in lengths.items():
        if length is None or length == 0:
            raise InputError(
                f"{name} has no list of values: give one value for each parameter set, e.g. [700.0, 800.0]"
            )
        if length != lengths[first]:
            raise InputError(
                f"{name} has {length} values, but {first} has {lengths[first]}: give equal numbers of values"
            )
    return int(lengths[first] or 0)


#: If all parameters belong to these tables, only the first parameter set gets all checks. In the other sets, only the
#: bounds of numbers and contradictions between numbers are checked, for example times that do not increase.
_MATERIAL = ("law", "viscosity", "porosity", "body", "region", "traction", "solve")


def _checked_lanes(scene: Scene, parameters: dict[str, jax.Array]) -> list[dict[str, np.ndarray]]:
    """Check the numbers of each parameter set and return the sets, or an empty list inside jit, grad or vmap.

    Raises:
        InputError: `simulate` would raise InputError for a parameter set. The message begins with the number of this
            set.
    """
    if any(isinstance(value, jax.core.Tracer) for value in parameters.values()):
        return []
    on_host = {name: np.asarray(value) for name, value in parameters.items()}
    lanes = [{name: value[k] for name, value in on_host.items()} for k in range(_lanes(parameters))]
    # For moduli, densities and loads, checks of bounds and histories are enough. Positions and directions need all
    # checks.
    placed = any(name.split(".")[0] not in _MATERIAL for name in on_host)
    for k, values in enumerate(lanes):
        own = with_parameters(scene, values)
        try:
            if k == 0 or placed:
                check_before_run(own)
            else:
                check_choices(own)  # for example, the times of a history must increase
                check_bounds(own)
        except InputError as error:
            raise InputError(f"parameter set {k} (counted from 0): {error}") from None
    return lanes
