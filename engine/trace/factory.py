"""Factory that makes the tracer that settings name."""

from octasplat.engine.trace.protocol import Tracer, TraceSettings


def make_tracer(
    settings: TraceSettings | None = None,
    *,
    threads: int = 0,
    box_padding: float = 0.0,
    build_quality: int = 1,
    is_used_once: bool = False,
) -> Tracer:
    """Return the tracer that ``settings`` name.

    Args:
        settings: which tracer, and where rays are cut off.
        threads: threads for building and tracing; 0 takes all.
        box_padding: for tracers with a hierarchy, see :class:`octasplat.engine.trace.cpu.CpuTracer`.
        build_quality: likewise; 0 is for scenes that change, 2 for those that are only looked at.
        is_used_once: whether a few rays are traced and no more, which is not worth the compilation of kernels
            for packets of rays.
    """
    settings = settings or TraceSettings()
    # Here, as each brings libraries that another one does without.
    if settings.tracer == "reference":
        from octasplat.engine.trace.reference_tracer import ReferenceTracer

        return ReferenceTracer(settings)
    from octasplat.engine.trace.cpu.tracer import CpuTracer

    return CpuTracer(
        settings,
        threads=threads,
        box_padding=box_padding,
        build_quality=build_quality,
        packet_mode="never" if is_used_once else "auto",
    )
