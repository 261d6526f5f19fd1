"""The tracer for any CPU: packets of neighbouring rays, and Embree for rays that come alone."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from engine.trace.cpu.tracer import CpuTracer

__all__ = ["CpuTracer"]


def __getattr__(name: str) -> Any:
    """Load the tracer once it is asked for: others take no more than its vectors."""
    if name == "CpuTracer":
        from engine.trace.cpu.tracer import CpuTracer

        return CpuTracer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
