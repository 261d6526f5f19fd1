"""Vectors of the processor's own width on each type of CPU: kernels for lanes, compiled but not run."""

import re
from pathlib import Path

import llvmlite.binding as llvm
import llvmlite.ir as ir
import numpy as np
import pytest
from numba import njit, types
from numba.extending import intrinsic

from octasplat.engine.trace.cpu.kernels import simd8, simd8_backward, simd16, simd_ops
from octasplat.engine.trace.cpu.kernels.ray_mask import ellipse_bins
from octasplat.engine.trace.cpu.kernels.simd_ops import DOUBLE8, INT8, MASK8, CompressedStore, load
from octasplat.engine.trace.cpu.kernels.simd_vector import boxes_in_frustum, ellipses_in_frustum
from tests.support.daily import some_daily

ADDRESS, DOUBLE, SINGLE, WORD = types.uintp, types.float64, types.float32, types.int64


def named(cls: type, member: types.Type = ADDRESS) -> types.Type:
    """Return the type of a named tuple whose members are alike."""
    return types.NamedUniTuple(member, len(cls._fields), cls)


MEET = (ADDRESS, named(simd8.PacketRay, SINGLE), WORD, WORD, named(simd8.HitBuffer))
KERNELS = {
    "intersect_block8": (simd8.intersect_block8, MEET),
    "eval_alphas8": (simd8.eval_alphas8, (ADDRESS, ADDRESS, WORD, SINGLE)),
    "rank_sort": (simd8.rank_sort, (ADDRESS, WORD, ADDRESS)),
    "composite8": (
        simd8.composite8,
        (ADDRESS, WORD, types.uint64, ADDRESS, DOUBLE, DOUBLE, ADDRESS, ADDRESS, ADDRESS),
    ),
    "lookup_slots8": (simd8.lookup_slots8, (ADDRESS, WORD, *(ADDRESS,) * 6)),
    "store_hits8": (
        simd8.store_hits8,
        (ADDRESS, WORD, ADDRESS, ADDRESS, named(simd8.HitTables), WORD, named(simd8.HitStore)),
    ),
    "accumulate_color_normals": (simd8.accumulate_color_normals, (ADDRESS,) * 4 + (WORD,)),
    "transmittance_before8": (simd8_backward.transmittance_before8, (ADDRESS, WORD, DOUBLE, ADDRESS)),
    "backward_hits8": (
        simd8_backward.backward_hits8,
        (
            named(simd8_backward.Hits8),
            ADDRESS,
            ADDRESS,
            WORD,
            DOUBLE,
            SINGLE,
            ADDRESS,
            named(simd8_backward.HitGradients8),
        ),
    ),
    "accumulate_row": (simd8_backward.accumulate_row, (ADDRESS, ADDRESS)),
    "intersect_group16": (simd16.intersect_group16, (*(ADDRESS,) * 4, WORD, *(SINGLE,) * 3)),
    "composite_group16": (simd16.composite_group16, (*(ADDRESS,) * 4, WORD, WORD, SINGLE)),
    "backward_group16": (simd16.backward_group16, (*(ADDRESS,) * 4, WORD, WORD, SINGLE)),
    "reduce_moments": (simd16.reduce_moments, (ADDRESS, ADDRESS)),
    "boxes_in_frustum": (boxes_in_frustum, (ADDRESS, ADDRESS, *(SINGLE,) * 3)),
    "ellipses_in_frustum": (ellipses_in_frustum, (ADDRESS, ADDRESS, *(SINGLE,) * 3)),
    "ellipse_bins": (ellipse_bins, (ADDRESS, ADDRESS, *(SINGLE,) * 3, ADDRESS, ADDRESS)),
}
CPUS = {
    # Whole registers, and products fused with sums, as the assembly of each writes them.
    "x86_64-unknown-linux-gnu sapphirerapids": (r"\sv\w+\s.*%[zy]mm", r"vfn?m(add|sub)\d+p[sd]\s.*%[zy]mm"),
    "x86_64-unknown-linux-gnu haswell": (r"\sv\w+\s.*%ymm", r"vfn?m(add|sub)\d+p[sd]\s.*%ymm"),
    "aarch64-unknown-linux-gnu neoverse-n1": (r"\sv\d+\.(2d|4s)", r"fml[as]\s+v\d+\.(2d|4s)"),
}
WITHOUT_PRODUCTS = (
    "rank_sort",
    "lookup_slots8",
    "store_hits8",
    "transmittance_before8",
    "accumulate_row",
    "reduce_moments",
    "composite8",
)


ALWAYS = {"backward_group16", "composite8", "boxes_in_frustum", "ellipse_bins"}
"""The largest ones; the others are exhaustive."""


@pytest.mark.parametrize("name", some_daily(KERNELS, ALWAYS))
def test_lanes_become_registers_on_each_cpu(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, kinds = KERNELS[name]
    arguments = ", ".join(f"a{k}" for k in range(len(kinds)))
    scope = {"kernel": kernel}
    exec(f"def call({arguments}):\n    return kernel({arguments})", scope)
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    for cpu, (whole, fused) in CPUS.items():
        triple, _, model = cpu.partition(" ")
        monkeypatch.setattr(simd_ops, "has_avx2_permute", lambda _context, m=model: m == "haswell")
        compiled = njit(kinds, _nrt=False)(scope["call"])
        code = compiled.inspect_llvm(kinds)
        code = re.sub(r'target (triple|datalayout) = ".*"\n', "", code)
        try:
            target = llvm.Target.from_triple(triple)
        except RuntimeError:
            pytest.skip(f"this LLVM compiles nothing for {triple}")
        machine = target.create_target_machine(cpu=model, opt=3)
        module = llvm.parse_assembly(f'target triple = "{triple}"\n{code}')
        assembly = machine.emit_assembly(module)
        assert re.search(whole, assembly), cpu
        assert name in WITHOUT_PRODUCTS or re.search(fused, assembly), cpu


@intrinsic
def pack(typingctx, words, numbers, bits, packed_words, packed_numbers):  # type: ignore[no-untyped-def]
    """Eight int32 and eight doubles without gaps, those of which ``bits`` has a one."""
    signature = types.int64(*(types.uintp,) * 2, types.int64, *(types.uintp,) * 2)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        words, numbers, bits, packed_words, packed_numbers = args
        mask = builder.bitcast(builder.trunc(bits, ir.IntType(8)), MASK8)
        gapless = CompressedStore(context, builder, mask)
        gapless.compress_store(load(builder, words, INT8), packed_words)
        gapless.compress_store(load(builder, numbers, DOUBLE8), packed_numbers)
        return gapless.count()

    return signature, codegen


@pytest.mark.parametrize("moves", [False, True])
def test_pack_moves_selected_lanes_together(moves: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = Path("/proc/cpuinfo").read_text().split() if Path("/proc/cpuinfo").exists() else []
    if moves and "avx2" not in flags:
        pytest.skip("this CPU has no AVX2")
    monkeypatch.setattr(simd_ops, "has_avx2_permute", lambda _context: moves)

    @njit
    def packed(words, numbers, bits, packed_words, packed_numbers):  # type: ignore[no-untyped-def]
        return pack(
            words.ctypes.data, numbers.ctypes.data, bits,
            packed_words.ctypes.data, packed_numbers.ctypes.data,
        )  # fmt: skip

    words, numbers = np.arange(10, 18, dtype=np.int32), np.linspace(0.1, 0.8, 8)
    for bits in range(256):
        chosen = np.flatnonzero([bits >> k & 1 for k in range(8)])
        found_words, found_numbers = np.zeros(16, np.int32), np.zeros(16)
        count = packed(words, numbers, bits, found_words, found_numbers)
        assert count == len(chosen)
        assert np.array_equal(found_words[:count], words[chosen])
        assert np.array_equal(found_numbers[:count], numbers[chosen])
        assert (found_numbers[8:] == 0).all(), "nothing is written beyond room for eight more"
