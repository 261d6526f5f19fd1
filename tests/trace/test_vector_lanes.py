"""Vectors of the processor's own width on each type of CPU: kernels for lanes, compiled but not run."""

import re
from pathlib import Path

import llvmlite.binding as llvm
import llvmlite.ir as ir
import numpy as np
import pytest
from numba import njit, types
from numba.extending import intrinsic

from octasplat.engine.trace.cpu import kernels_eight, kernels_eight_backward, kernels_lanes, kernels_sixteen
from octasplat.engine.trace.cpu.kernels_footprint import footprints
from octasplat.engine.trace.cpu.kernels_lanes import DOUBLE8, INT8, MASK8, Gapless, load
from octasplat.engine.trace.cpu.kernels_simd import boxes_in_pyramid, ellipses_in_pyramid

ADDRESS, DOUBLE, SINGLE, WORD = types.uintp, types.float64, types.float32, types.int64
MEET = (ADDRESS, *(SINGLE,) * 5, WORD, WORD, *(ADDRESS,) * 6)
KERNELS = {
    "meet_block": (kernels_eight.meet_block, MEET),
    "write_alphas": (kernels_eight.write_alphas, (ADDRESS, ADDRESS, WORD, SINGLE)),
    "sort_few": (kernels_eight.sort_few, (ADDRESS, WORD, ADDRESS)),
    "weigh_next": (
        kernels_eight.weigh_next,
        (ADDRESS, WORD, types.uint64, ADDRESS, DOUBLE, DOUBLE, ADDRESS, ADDRESS, ADDRESS),
    ),
    "know_slots": (kernels_eight.know_slots, (ADDRESS, WORD, *(ADDRESS,) * 6)),
    "keep_hits": (kernels_eight.keep_hits, (ADDRESS, WORD, *(ADDRESS,) * 4, WORD, *(ADDRESS,) * 5)),
    "add_shown": (kernels_eight.add_shown, (ADDRESS,) * 4 + (WORD,)),
    "walk_through": (kernels_eight_backward.walk_through, (ADDRESS, WORD, DOUBLE, ADDRESS)),
    "replay_hits": (
        kernels_eight_backward.replay_hits,
        (*(ADDRESS,) * 7, WORD, DOUBLE, SINGLE, *(ADDRESS,) * 4),
    ),
    "add_row": (kernels_eight_backward.add_row, (ADDRESS, ADDRESS)),
    "meet_group": (kernels_sixteen.meet_group, (*(ADDRESS,) * 4, WORD, *(SINGLE,) * 3)),
    "show_group": (kernels_sixteen.show_group, (*(ADDRESS,) * 4, WORD, WORD, SINGLE)),
    "replay_group": (kernels_sixteen.replay_group, (*(ADDRESS,) * 4, WORD, WORD, SINGLE)),
    "add_up": (kernels_sixteen.add_up, (ADDRESS, ADDRESS)),
    "boxes_in_pyramid": (boxes_in_pyramid, (ADDRESS, ADDRESS, *(SINGLE,) * 3)),
    "ellipses_in_pyramid": (ellipses_in_pyramid, (ADDRESS, ADDRESS, *(SINGLE,) * 3)),
    "footprints": (footprints, (ADDRESS, ADDRESS, *(SINGLE,) * 3, ADDRESS, ADDRESS)),
}
CPUS = {
    # Whole registers, and products fused with sums, as the assembly of each writes them.
    "x86_64-unknown-linux-gnu sapphirerapids": (r"\sv\w+\s.*%[zy]mm", r"vfn?m(add|sub)\d+p[sd]\s.*%[zy]mm"),
    "x86_64-unknown-linux-gnu haswell": (r"\sv\w+\s.*%ymm", r"vfn?m(add|sub)\d+p[sd]\s.*%ymm"),
    "aarch64-unknown-linux-gnu neoverse-n1": (r"\sv\d+\.(2d|4s)", r"fml[as]\s+v\d+\.(2d|4s)"),
}
WITHOUT_PRODUCTS = ("sort_few", "know_slots", "keep_hits", "walk_through", "add_row", "add_up", "weigh_next")


@pytest.mark.parametrize("name", KERNELS)
def test_lanes_become_registers_on_each_cpu(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel, kinds = KERNELS[name]
    arguments = ", ".join(f"a{k}" for k in range(len(kinds)))
    scope = {"kernel": kernel}
    exec(f"def call({arguments}):\n    return kernel({arguments})", scope)
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    for cpu, (whole, fused) in CPUS.items():
        triple, _, model = cpu.partition(" ")
        monkeypatch.setattr(kernels_lanes, "moves_lanes", lambda _context, m=model: m == "haswell")
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
        gapless = Gapless(context, builder, mask)
        gapless.put(load(builder, words, INT8), packed_words)
        gapless.put(load(builder, numbers, DOUBLE8), packed_numbers)
        return gapless.count()

    return signature, codegen


@pytest.mark.parametrize("moves", [False, True])
def test_lanes_without_gaps(moves: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = Path("/proc/cpuinfo").read_text().split() if Path("/proc/cpuinfo").exists() else []
    if moves and "avx2" not in flags:
        pytest.skip("this CPU has no AVX2")
    monkeypatch.setattr(kernels_lanes, "moves_lanes", lambda _context: moves)

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
