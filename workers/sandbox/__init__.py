"""Sandbox of processes that handle untrusted data, as far as the kernel supports it.

Parents hide their memory from their children (:mod:`octasplat.workers.sandbox.hiding`). Children that read
untrusted data give up the network, access to other processes, and the folders of the service, for good
(:mod:`octasplat.workers.sandbox.confinement`). Supported features are found by
:mod:`octasplat.workers.sandbox.capabilities`.
"""
