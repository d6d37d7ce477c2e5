"""Determine how much memory (RAM) a factorisation may use."""

import os
from pathlib import Path

#: File of Linux with the free memory [kB], and folder of the memory limits [bytes] of the container.
_FREE, _CONTAINER = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def free_memory() -> float:
    """Return the memory [bytes] that this process can still allocate; infinite if the system does not report it."""
    try:
        lines = dict(line.split(":") for line in _FREE.read_text().splitlines())
        free = 1024 * float(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        try:
            free = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, OSError, ValueError):  # Windows has no sysconf
            return float("inf")
    try:
        limit, used = (float((_CONTAINER / f"memory.{name}").read_text()) for name in ("max", "current"))
        lines = dict(line.split() for line in (_CONTAINER / "memory.stat").read_text().splitlines())
        # The system frees this part of the file cache if a process needs memory.
        return min(free, limit - used + float(lines.get("inactive_file", 0)))
    except (OSError, ValueError):  # the process is in no container, or the container has no limit ("max")
        return free
