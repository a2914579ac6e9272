"""The best instruction set of this machine's CPU for products of bytes.

It decides which int8 kernels an inference engine uses, and so how long a step takes. It does not
change the result. State it beside every time that is compared with another machine's.
"""

import platform
import subprocess
import sys
from collections.abc import Collection
from functools import cache
from pathlib import Path

UNKNOWN = "unknown"
# From the best to the least, with the names of the feature in Linux and in macOS.
_NAMES = {
    "AVX-512-VNNI": ("avx512_vnni", "avx512vnni"),
    "AVX-VNNI": ("avx_vnni", "avxvnni"),
    "AVX-512": ("avx512bw",),
    "AVX2": ("avx2",),
    "NEON dot": ("asimddp", "hw.optional.arm.feat_dotprod"),
    "NEON": ("asimd", "hw.optional.neon"),
}
_CPUINFO = Path("/proc/cpuinfo")


@cache
def instruction_set() -> str:
    """Return its name, such as "AVX2", or "unknown" if the system does not report it."""
    match sys.platform:
        case "linux":
            return best_of(linux_features(_CPUINFO.read_text("utf-8", errors="replace")))
        case "darwin":
            return best_of(macos_features(_sysctl()))
        case _:
            return UNKNOWN  # Windows reports AVX2 and AVX-512, but not VNNI


def best_of(features: Collection[str]) -> str:
    """Return the best instruction set that the features of a CPU include."""
    return next((name for name, words in _NAMES.items() if set(words) & {*features}), UNKNOWN)


def linux_features(cpuinfo: str) -> set[str]:
    """Return the features of the first CPU in the text of /proc/cpuinfo."""
    for line in cpuinfo.splitlines():
        key, _, value = line.partition(":")
        if key.strip().lower() in ("flags", "features"):
            return set(value.lower().split())
    return set()


def macos_features(sysctl: str) -> set[str]:
    """Return the features in lines of ``sysctl``: "machdep.cpu.features: SSE ..." or "NAME: 1"."""
    found: set[str] = set()
    for line in sysctl.lower().splitlines():
        key, _, value = line.partition(":")
        if key.startswith("machdep.cpu."):
            found.update(value.split())
        elif value.strip() == "1":
            found.add(key.strip())
    return found


def _sysctl() -> str:
    key = "hw.optional" if platform.machine() == "arm64" else "machdep.cpu"
    try:
        done = subprocess.run(["/usr/sbin/sysctl", key], capture_output=True, text=True, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout
