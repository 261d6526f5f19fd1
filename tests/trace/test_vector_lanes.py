"""Vectors of the processor's own width on each type of CPU: kernels for eight lanes, compiled but not run."""

import re

import llvmlite.binding as llvm
import pytest
from numba import njit, types

from engine.trace.cpu import kernels_eight, kernels_eight_backward
from engine.trace.cpu.kernels_simd import boxes_in_pyramid, ellipses_in_pyramid

ADDRESS, DOUBLE, SINGLE, WORD = types.uintp, types.float64, types.float32, types.int64
MEET = (ADDRESS, DOUBLE, DOUBLE, DOUBLE, SINGLE, SINGLE, WORD, WORD, *(ADDRESS,) * 6)
KERNELS = {
    "meet_block": (kernels_eight.meet_block, MEET),
    "write_alphas": (kernels_eight.write_alphas, (ADDRESS, ADDRESS, WORD, DOUBLE)),
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
    "boxes_in_pyramid": (boxes_in_pyramid, (ADDRESS, ADDRESS, *(DOUBLE,) * 3)),
    "ellipses_in_pyramid": (ellipses_in_pyramid, (ADDRESS, ADDRESS, *(DOUBLE,) * 3)),
}
CPUS = {
    # Whole registers, and products fused with sums, as the assembly of each writes them.
    "x86_64-unknown-linux-gnu sapphirerapids": (r"\sv\w+\s.*%[zy]mm", r"vfn?m(add|sub)\d+p[sd]\s.*%[zy]mm"),
    "x86_64-unknown-linux-gnu haswell": (r"\sv\w+\s.*%ymm", r"vfn?m(add|sub)\d+p[sd]\s.*%ymm"),
    "aarch64-unknown-linux-gnu neoverse-n1": (r"\sv\d+\.(2d|4s)", r"fml[as]\s+v\d+\.(2d|4s)"),
}
WITHOUT_PRODUCTS = ("sort_few", "know_slots", "keep_hits", "walk_through", "add_row", "weigh_next")


@pytest.mark.parametrize("name", KERNELS)
def test_lanes_become_registers_on_each_cpu(name: str) -> None:
    kernel, kinds = KERNELS[name]
    arguments = ", ".join(f"a{k}" for k in range(len(kinds)))
    scope = {"kernel": kernel}
    exec(f"def call({arguments}):\n    return kernel({arguments})", scope)
    compiled = njit(kinds, _nrt=False)(scope["call"])
    code = compiled.inspect_llvm(kinds)
    code = re.sub(r'target (triple|datalayout) = ".*"\n', "", code)
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    for cpu, (whole, fused) in CPUS.items():
        triple, _, model = cpu.partition(" ")
        try:
            target = llvm.Target.from_triple(triple)
        except RuntimeError:
            pytest.skip(f"this LLVM compiles nothing for {triple}")
        machine = target.create_target_machine(cpu=model, opt=3)
        module = llvm.parse_assembly(f'target triple = "{triple}"\n{code}')
        assembly = machine.emit_assembly(module)
        assert re.search(whole, assembly), cpu
        assert name in WITHOUT_PRODUCTS or re.search(fused, assembly), cpu
