"""Program that compiles the kernels of groups: ``python -m ... NUMBER GROUP...``.

Of several such processes those with an odd number begin at the end of the list. Each leaves out what another
one is compiling.
"""

import sys
from collections.abc import Sequence
from contextlib import suppress

from octasplat.engine.core.kernel_signatures import compile_kernel
from octasplat.engine.operations.precompile import kernels_of


def compile_groups(number: int, groups: Sequence[str]) -> None:
    """Compile all kernels of the groups, from the end of the list for an odd ``number``."""
    todo = list(kernels_of(groups))
    for found in reversed(todo) if number % 2 else todo:
        # A kernel that has moved since the table was written is compiled when it is called.
        with suppress(ImportError, AttributeError):
            compile_kernel(found.module, found.function, found.arguments, skip_busy=True)


if __name__ == "__main__":
    compile_groups(int(sys.argv[1]), sys.argv[2:])
