"""Determine how much memory (RAM) a factorisation may use."""

import os
from pathlib import Path

#: Three files of Linux. They contain the free memory [kB], the memory limit of the container [bytes], and the memory
#: that the container uses [bytes].
_FREE, _LIMIT, _USED = Path("/proc/meminfo"), Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")


def free_memory() -> float:
    """Memory [bytes] that this process can still allocate; infinite if the system does not report it."""
    try:
        lines = dict(line.split(":") for line in _FREE.read_text().splitlines())
        free = 1024 * float(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        try:
            free = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        except (AttributeError, OSError, ValueError):  # Windows has no sysconf
            return float("inf")
    try:
        return min(free, float(_LIMIT.read_text()) - float(_USED.read_text()))
    except (OSError, ValueError):  # the process is in no container, or the container has no limit ("max")
        return free
