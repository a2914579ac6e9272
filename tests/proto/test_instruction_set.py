"""Laws of the instruction set: the best one that the system names, and no guess."""

from __future__ import annotations

import sys

import pytest

from vergence_proto.instruction_set import (
    UNKNOWN,
    best_of,
    instruction_set,
    linux_features,
    macos_features,
)

CPUINFO = """processor\t: 0
model name\t: A CPU
flags\t\t: fpu sse2 {}
bugs\t\t: avx512_vnni_erratum

processor\t: 1
flags\t\t: fpu sse2 avx2 avx512_vnni
"""
ARM_CPUINFO = "processor\t: 0\nBogoMIPS\t: 50.00\nFeatures\t: fp asimd {}\n"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("avx2 avx512f avx512bw avx512_vnni avx_vnni", "AVX-512-VNNI"),
        ("avx2 avx_vnni", "AVX-VNNI"),
        ("avx2 avx512f avx512bw", "AVX-512"),
        ("avx avx2 fma", "AVX2"),
        ("avx", UNKNOWN),
    ],
)
def test_linux_on_x86_names_its_best(flags: str, expected: str) -> None:
    assert best_of(linux_features(CPUINFO.format(flags))) == expected


@pytest.mark.parametrize(("features", "expected"), [("asimddp crc32", "NEON dot"), ("", "NEON")])
def test_linux_on_arm_names_its_best(features: str, expected: str) -> None:
    assert best_of(linux_features(ARM_CPUINFO.format(features))) == expected


@pytest.mark.parametrize(
    ("sysctl", "expected"),
    [
        ("hw.optional.neon: 1\nhw.optional.arm.FEAT_DotProd: 1\n", "NEON dot"),
        ("hw.optional.neon: 1\nhw.optional.arm.FEAT_DotProd: 0\n", "NEON"),
        (
            "machdep.cpu.features: FPU SSE2 AVX1.0\nmachdep.cpu.leaf7_features: BMI2 AVX2 FMA\n",
            "AVX2",
        ),
        ("machdep.cpu.leaf7_features: AVX2 AVX512BW AVX512VNNI\n", "AVX-512-VNNI"),
        ("", UNKNOWN),
    ],
)
def test_macos_names_its_best(sysctl: str, expected: str) -> None:
    assert best_of(macos_features(sysctl)) == expected


def test_a_cpuinfo_without_features_is_unknown() -> None:
    assert best_of(linux_features("processor: 0\n")) == UNKNOWN


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc/cpuinfo")
def test_this_machine_has_a_name() -> None:
    assert instruction_set() != ""
