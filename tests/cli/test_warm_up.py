"""``octasplat warm-up`` compiles the kernels of commands, and says what there is none of."""

from octasplat.engine.operations.cost_model import Estimate
from octasplat.engine.operations.precompile import missing_kernels
from tests.cli.conftest import Octasplat


def test_kernels_of_a_command_are_there_afterwards(octasplat: Octasplat) -> None:
    assert octasplat("warm-up", "stage-init").exit_code == 0
    assert missing_kernels(["stage-init"]) == ()
    again = octasplat("warm-up", "stage-init")
    assert again.exit_code == 0
    assert "Compiling" not in again.output
    assert again.output.startswith("All kernels are compiled; their machine code is in ")


def test_command_without_kernels_is_refused(octasplat: Octasplat) -> None:
    said = octasplat("warm-up", "crop")
    assert said.exit_code == 2
    assert "crop has no kernels of its own; choose among reconstruct, " in said.output


def test_estimate_counts_a_cold_start() -> None:
    warm = Estimate(cpu_seconds=100.0, seconds=60.0, cores=2, memory_bytes=10**9)
    cold = warm.with_cold_start(20.0)
    assert (cold.cpu_seconds, cold.seconds, cold.cold_start_seconds) == (120.0, 80.0, 20.0)
    assert "20 s of it to compile kernels" in cold.text
    assert "compile" not in warm.text
