"""The tracer for any CPU: packets of neighbouring rays, and Embree for rays that come alone.

It is in :mod:`octasplat.engine.trace.cpu.tracer`, and not loaded for those that take no more than its
vectors.
"""
