"""The tracer for any CPU: packets of neighbouring rays, and Embree for rays that come alone."""

from engine.trace.cpu.tracer import CpuTracer

__all__ = ["CpuTracer"]
