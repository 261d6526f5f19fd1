"""``octasplat warm-up``: compiles what the first use would wait for."""

import click

from octasplat.workers.cli.printing import Printer, output_options


@click.command("warm-up", short_help="Compile everything that the first use would wait for.")
@click.argument("commands", nargs=-1, metavar="[COMMAND]...")
@output_options
def warm_up(commands: tuple[str, ...], printer: Printer) -> None:
    """Compile the kernels of these commands, or of all, and keep their machine code.

    It is kept in NUMBA_CACHE_DIR, or in the user's cache folder, for this version of the program and this
    type of processor. Kernels that are not compiled here are compiled when they are needed first.
    """
    import time

    from octasplat.engine.core.durations import format_duration
    from octasplat.engine.core.errors import OutputError
    from octasplat.engine.core.kernel_folder import cache_folder
    from octasplat.engine.operations.precompile import compile_now, kernel_groups, missing_kernels

    groups = commands or kernel_groups()
    if unknown := sorted(set(groups) - set(kernel_groups())):
        known = ", ".join(kernel_groups())
        raise click.UsageError(f"{unknown[0]} has no kernels of its own; choose among {known}.")
    began, missing = time.monotonic(), len(missing_kernels(groups))
    if missing:
        printer.note(f"Compiling {missing} kernels")
        compile_now(groups)
        if missing_kernels(groups):
            raise OutputError(f"Some kernels could not be compiled, or not be kept in {cache_folder()}.")
    seconds = time.monotonic() - began
    took = f" in {format_duration(seconds)}" if missing else ""
    printer.print(
        {"compiled": missing, "seconds": round(seconds, 1), "folder": cache_folder()},
        [f"All kernels are compiled{took}; their machine code is in {cache_folder()}."],
    )
