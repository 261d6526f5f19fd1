"""Vectors of the processor's own width on each type of CPU: kernels for eight lanes, compiled but not run."""

import re

import llvmlite.binding as llvm
import pytest
from numba import njit, types

from engine.trace.cpu import kernels_eight
from engine.trace.cpu.kernels_simd import boxes_in_pyramid, ellipses_in_pyramid

ADDRESS, DOUBLE, SINGLE, WORD = types.uintp, types.float64, types.float32, types.int64
MEET = (ADDRESS, DOUBLE, DOUBLE, DOUBLE, SINGLE, SINGLE, WORD, WORD, *(ADDRESS,) * 6)
KERNELS = {
    "meet_block": (kernels_eight.meet_block, MEET),
    "write_alphas": (kernels_eight.write_alphas, (ADDRESS, ADDRESS, WORD, DOUBLE)),
    "weigh": (kernels_eight.weigh, (ADDRESS, WORD, DOUBLE, DOUBLE, ADDRESS, ADDRESS)),
    "add_shown": (kernels_eight.add_shown, (ADDRESS,) * 4 + (WORD,)),
    "share_out": (kernels_eight.share_out, (*(ADDRESS,) * 3, WORD, DOUBLE, SINGLE, ADDRESS, ADDRESS)),
    "add_moments": (kernels_eight.add_moments, (ADDRESS, *(SINGLE,) * 4, ADDRESS)),
    "boxes_in_pyramid": (boxes_in_pyramid, (ADDRESS, ADDRESS, *(DOUBLE,) * 3)),
    "ellipses_in_pyramid": (ellipses_in_pyramid, (ADDRESS, ADDRESS, *(DOUBLE,) * 3)),
}
CPUS = {
    # Products of whole registers, as the assembly of each writes them.
    "x86_64-unknown-linux-gnu sapphirerapids": r"v(f\w+(add|sub)\w+|mul)p[sd]\s.*%[zy]mm",
    "x86_64-unknown-linux-gnu haswell": r"v(f\w+(add|sub)\w+|mul)p[sd]\s.*%ymm",
    "aarch64-unknown-linux-gnu neoverse-n1": r"fm(la|ls|ul)\s+v\d+\.(2d|4s)",
}


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
    for cpu, fused in CPUS.items():
        triple, _, model = cpu.partition(" ")
        try:
            target = llvm.Target.from_triple(triple)
        except RuntimeError:
            pytest.skip(f"this LLVM compiles nothing for {triple}")
        machine = target.create_target_machine(cpu=model, opt=3)
        module = llvm.parse_assembly(f'target triple = "{triple}"\n{code}')
        assembly = machine.emit_assembly(module)
        assert re.search(fused, assembly), cpu
