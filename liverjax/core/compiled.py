"""Compile a function for given arguments, and keep the compiled program (below: "program") on disk.

Before JAX can find a program in its cache, it must trace the function, that is, run its Python code with abstract
values instead of numbers. This takes seconds for a large function. This module finds a program without tracing: the
file name of the program contains a key, which is computed from the structure and the shapes of the arguments. The files
are in the folder of `liverjax.core.program_cache`.
"""

import dataclasses
import hashlib
import math
import os
import pickle
import uuid
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from liverjax.core import program_cache
from liverjax.core.files import whole

#: Packages whose functions and structs a stored program may use. The name of the folder of stored programs
#: (`program_cache.folder`) contains a digest of the source files of these packages.
OWN = ("liverjax.", "fitting.")


#: Compiler options for a program that takes longer to compile than to run: they select XLA's older CPU kernels. The
#: newer kernels run up to twice as fast, but take 1.5 times as long to compile. jax 0.11 and later have only the newer
#: kernels.
_QUICK: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}


class _Unknown(Exception):
    """Raised if no key can be computed for a function or an argument, for example for a law that a user has written."""


def compiled(function: Callable[..., Any], *arguments: Any, short: bool = False) -> Callable[..., Any]:
    """Return `function`, compiled for arguments with these types and shapes, on one device.

    If the program is stored on disk, it is read and not compiled again. A call of the compiled function compiles
    nothing; its arguments must have the same types and shapes.

    Args:
        function: a function at the top level of a module, or `functools.partial` of such a function. The keywords of
            the partial become constants of the program.
        arguments: pytrees of arrays and numbers. If they contain structs that a user has defined, the program is not
            stored on disk.
        short: whether the program runs for a second or less. If true, a short compilation is more important than a
            short run.
    """
    folder, options = program_cache.folder(), _QUICK if short and jax.default_backend() == "cpu" else {}
    if folder is None or jax.default_backend() != "cpu":  # programs for other devices are only in JAX's cache
        return jax.jit(function).lower(*arguments).compile(options)
    try:
        file = folder / f"whole_{_function_name(function)}-{_key(function, arguments, options)}-cache"
    except _Unknown:
        return jax.jit(function).lower(*arguments).compile(options)
    return _found(file) or _made(file, function, arguments, options)


def _made(file: Path, function: Callable[..., Any], arguments: tuple, options: dict) -> Callable[..., Any]:
    """Compile the function, and store the program in `file` if possible.

    The compiled function has flat lists of arrays as arguments and results, because JAX can store only such lists.
    """
    structure = jax.tree.structure(arguments)
    shape: list[Any] = []

    def flat(*leaves: jax.Array) -> list[jax.Array]:
        out = function(*jax.tree.unflatten(structure, leaves))
        shape[:] = [jax.tree.structure(out)]
        return jax.tree.leaves(out)

    # JAX's own cache must not find or store this program: a program that JAX has read from disk cannot be stored again.
    flat.__name__ = f"program_{uuid.uuid4().hex}"
    keep_from = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", math.inf)
    try:
        program = jax.jit(flat).lower(*jax.tree.leaves(arguments)).compile(options)
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", keep_from)
    try:
        from jax.experimental import serialize_executable

        example = jax.tree.unflatten(shape[0], range(shape[0].num_leaves))
        content = zlib.compress(pickle.dumps((*serialize_executable.serialize(program), example)), 1)
        with whole(file) as beside:
            beside.write_bytes(content)
    except Exception:  # e.g. callbacks in the program, or a full disk: the program runs, but is not stored
        pass
    return partial(_called, program, shape[0])


def _found(file: Path) -> Callable[..., Any] | None:
    """Read the program that is stored in a file. Returns None if the file does not exist or cannot be read."""
    if not file.exists():
        return None
    try:
        from jax.experimental import serialize_executable

        # A stored program may call SciPy's LAPACK, which JAX registers only when it first lowers (translates) a
        # factorisation.
        jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.result_type(float)))
        kept, given, taken, example = pickle.loads(zlib.decompress(file.read_bytes()))
        program = serialize_executable.deserialize_and_load(kept, given, taken, execution_devices=jax.devices()[:1])
        return partial(_called, program, jax.tree.structure(example))
    except Exception:  # a broken file, or a file of another JAX version: the program is compiled and stored again
        return None


def _called(program: Callable[..., Any], structure: jax.tree_util.PyTreeDef, *arguments: Any) -> Any:
    return jax.tree.unflatten(structure, program(*jax.tree.leaves(arguments)))


def _function_name(function: Callable[..., Any]) -> str:
    return _top(function.func if isinstance(function, partial) else function)


def _top(function: Any) -> str:
    """Return the name of a function at the top level of a module.

    Raises `_Unknown` if the function is defined inside another function, or outside of the packages `OWN`.
    """
    module, name = function.__module__, function.__qualname__
    if not module.startswith(OWN) or not name.isidentifier():
        raise _Unknown
    return f"{module}.{name}"


def _key(function: Callable[..., Any], arguments: tuple, options: dict | None = None) -> str:
    """Return a digest of everything on which the compiled program depends, except the source files."""
    fixed = function.keywords if isinstance(function, partial) else {}
    if isinstance(function, partial) and function.args:
        raise _Unknown
    config = {k: str(v) for k, v in jax.config.values.items() if "cache" not in k and "log" not in k}
    said = [
        _said(fixed, static=True),
        _said(arguments),
        sorted(config.items()),
        os.environ.get("XLA_FLAGS"),
        options or {},
    ]
    return hashlib.sha256(repr((jax.default_backend(), said)).encode()).hexdigest()


def _said(thing: Any, static: bool = False) -> Any:
    """Describe an argument for the key by its types, its static values, and the shapes of all other numbers."""
    if thing is None or isinstance(thing, (str, bool)):
        return repr(thing)
    if isinstance(thing, FunctionType) and static:
        return _top(thing)
    if isinstance(thing, (int, float)):
        return repr(thing) if static else type(thing).__name__
    if isinstance(thing, (np.ndarray, np.generic, jax.Array)) and not static:
        return (str(thing.dtype), thing.shape, bool(getattr(thing, "weak_type", False)))
    kind = f"{type(thing).__module__}.{type(thing).__qualname__}"
    if isinstance(thing, dict):
        return [(_said(key, True), _said(value, static)) for key, value in thing.items()]
    if not (kind.startswith(OWN) or kind in ("builtins.tuple", "builtins.list")):
        raise _Unknown
    if dataclasses.is_dataclass(thing):
        fields = [(f.name, f.metadata.get("static", False)) for f in dataclasses.fields(thing)]
        return kind, [(name, _said(getattr(thing, name), static or fixed)) for name, fixed in fields]
    if isinstance(thing, (tuple, list)):
        return kind, [_said(value, static) for value in thing]
    raise _Unknown
