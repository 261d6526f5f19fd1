"""Tracer for any CPU: packets of neighbouring rays, and single rays through Embree.

It is in :mod:`octasplat.engine.trace.cpu.tracer`, and not loaded by modules that use only its vectors.
"""
