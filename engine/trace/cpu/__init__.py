"""The tracer for any CPU: packets of neighbouring rays, and single rays through Embree.

It is in :mod:`octasplat.engine.trace.cpu.tracer`, and not loaded for those that take no more than its
vectors.
"""
