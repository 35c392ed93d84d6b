"""How much memory there is."""

import os
from pathlib import Path


def memory_gib(group: Path = Path("/sys/fs/cgroup")) -> tuple[float, float]:
    """
    :param group: where Linux tells a container's limit
    :return: free and total GiB, of the machine or, if that is less, of the container
    """
    page = os.sysconf("SC_PAGE_SIZE")
    total, free = os.sysconf("SC_PHYS_PAGES") * page, os.sysconf("SC_AVPHYS_PAGES") * page
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():  # "available" counts what the system would give back, "free" does not
        fields = dict(line.split(":") for line in meminfo.read_text().splitlines() if ":" in line)
        free = int(fields.get("MemAvailable", str(free // 1024)).split()[0]) * 1024
    limit, used = (group / name for name in ("memory.max", "memory.current"))
    if limit.exists() and used.exists() and limit.read_text().strip().isdigit():
        allowed = int(limit.read_text())
        details = group / "memory.stat"
        fields = dict(line.split() for line in details.read_text().splitlines()) if details.exists() else {}
        # files that nobody has touched for a while count as used, and are given back as soon as memory is wanted
        held = int(used.read_text()) - int(fields.get("inactive_file", "0"))
        total, free = min(total, allowed), min(free, allowed - held)
    return free / 2**30, total / 2**30
