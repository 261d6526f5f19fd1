"""Program that compiles the kernels of groups: ``python -m ... NUMBER GROUP...``.

The groups are compiled one after another. Of several such processes those with an odd number begin at the end
of each group. Each leaves out what another one is compiling.
"""

import sys
from collections.abc import Sequence
from contextlib import suppress

from octasplat.engine.core.kernel_signatures import compile_kernel
from octasplat.engine.operations.precompile import kernels_by_group


def compile_groups(number: int, groups: Sequence[str]) -> None:
    """Compile all kernels of the groups, from the end of each group for an odd ``number``."""
    for kernels in kernels_by_group(groups):
        for found in reversed(kernels) if number % 2 else kernels:
            # A kernel that has moved since the table was written is compiled when it is called.
            with suppress(ImportError, AttributeError):
                compile_kernel(found.module, found.function, found.arguments, skip_busy=True)


if __name__ == "__main__":
    compile_groups(int(sys.argv[1]), sys.argv[2:])
