"""Keep compiled programs (below: "programs") on disk, so that a machine compiles each program only once.

JAX's cache stores the programs in a separate folder of the user's cache directory. The name of the folder depends
on the versions of liverjax and JAX, on the source files and on the processor. So other versions, sources or machines
never use these programs. The environment variable `LIVERJAX_CACHE` can name another folder; "off" means no cache.
"""

import hashlib
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

SWITCH = "LIVERJAX_CACHE"
#: Maximum total size of all programs on disk [bytes]. If the total is larger, the next command removes the least
#: recently used programs. A program takes 10 kB to 1 MB.
LIMIT = 500_000_000
#: A program is stored only if its compilation takes at least this time [s]. Reading a program takes a few milliseconds.
WORTH_KEEPING = 0.05


_in_use: list[Path] = []


def folder() -> Path | None:
    """Return the folder in which programs are stored now.

    Returns None outside of the context `kept_on_disk`, or if there is no cache.
    """
    return _in_use[-1] if _in_use else None


@contextmanager
def kept_on_disk() -> Iterator[Path | None]:
    """Read and write compiled programs on disk inside this context.

    The context manager yields the folder of the cache, or None if there is no cache. There is no cache if
    `LIVERJAX_CACHE` is "off" or if the folder cannot be written. If the user has set a folder for JAX's cache
    (`JAX_COMPILATION_CACHE_DIR`), JAX uses that folder, and this cache is not used. Programs that cannot be read are
    compiled again.
    """
    chosen = _folder()
    with warnings.catch_warnings():
        # The cache warns of broken entries, a full disk, or entries that another process removed. These warnings are
        # not shown, since the programs are then only compiled again.
        warnings.filterwarnings("always", "Error (reading|writing) persistent compilation cache")
        show = warnings.showwarning

        def shown(message: Warning | str, *details: object) -> None:
            if chosen is None or not _forgotten(chosen, str(message)):
                show(message, *details)  # type: ignore[arg-type]

        warnings.showwarning = shown  # type: ignore[assignment]
        if chosen is None:
            yield None
            return
        _switch_on(chosen)
        _in_use.append(chosen)
        try:
            yield chosen
        finally:
            _in_use.pop()


def _switch_on(folder: Path) -> None:
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING)
    # JAX itself sets TF_CPP_MIN_LOG_LEVEL to 1 if the user has not set it.
    if "JAX_LOGGING_LEVEL" not in os.environ and os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        # XLA logs an error for every CPU program that it reads, because it treats two of its own tuning flags as
        # missing features of the processor. The programs in the folder are only for this processor, so the error is
        # wrong.
        jax.config.update("jax_logging_level", "CRITICAL")


def _folder() -> Path | None:
    """Return the folder for these versions, source files and processor. Make this folder, and remove old programs.

    Returns None if this cache is not used: it is switched off, JAX uses another folder, or the folder cannot be
    written.
    """
    chosen = os.environ.get(SWITCH, "")
    if chosen.lower() == "off" or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return None
    try:
        root = Path(chosen).expanduser() if chosen else _user_cache() / "liverjax"
        folder = root / _name()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            return None
        bound(root)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home directory
        return None
    return folder.absolute()


def _user_cache() -> Path:
    """Return the user's cache directory on this platform."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return given if given.is_absolute() else Path.home() / ".cache"  # by the XDG standard, relative paths are ignored


def _name() -> str:
    """Return the name of the folder: the versions of liverjax and JAX, and a digest of source files and processor."""
    import liverjax

    package = Path(liverjax.__file__).parent
    digest = hashlib.sha256(_processor().encode())
    for file in sorted([*package.rglob("*.py"), *(package.parent / "fitting").rglob("*.py")]):
        digest.update(file.relative_to(package.parent).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return f"{liverjax.__version__}-jax{version('jax')}-jaxlib{version('jaxlib')}-{digest.hexdigest()[:16]}"


def _processor() -> str:
    """Return kind and features of the processor. A program compiled for one processor may not run on another one."""
    said = f"{platform.system()} {platform.machine()} {platform.processor()}\n"
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return said
    wanted = ("model name", "flags", "features", "cpu implementer", "cpu part", "isa")
    return said + "\n".join(line for line in first.splitlines() if line.lower().startswith(wanted))


def _forgotten(folder: Path, message: str) -> bool:
    """Return whether a warning is about the cache.

    If the warning names a broken entry, this entry is removed. Otherwise JAX would try to read it again and again.
    """
    if "persistent compilation cache" not in message:
        return False
    if "reading" in message:
        program = message.partition("entry for '")[2].partition("'")[0]
        for entry in folder.glob(f"{program}-*-cache") if program.isidentifier() else ():
            _remove(entry)
    return True


def bound(root: Path, limit: int = LIMIT) -> None:
    """Remove the least recently used programs, until the programs of all versions take at most `limit` bytes."""
    entries = []
    for entry in root.glob("*/*-cache"):
        try:
            found = entry.stat()
        except OSError:  # another process has removed the entry
            continue
        # Some file systems do not record when a file was last read. Then the time at which it was written is used.
        entries.append((max(found.st_atime, found.st_mtime), found.st_size, entry))
    left = sum(size for _, size, _ in entries)
    for _, size, entry in sorted(entries):
        if left <= limit:
            break
        _remove(entry)
        left -= size


def _remove(entry: Path) -> None:
    try:
        entry.unlink()
    except OSError:  # the entry is already removed, or in use (on Windows): the next command tries again
        return
