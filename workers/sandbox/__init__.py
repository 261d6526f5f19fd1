"""Processes that cannot do what their work does not need, as far as the kernel takes part.

Parents hide what they know from their children (:mod:`octasplat.workers.sandbox.hiding`). Children that
read what others have made give up the network, what watches over other processes, and the folders of the
service, for good (:mod:`octasplat.workers.sandbox.confinement`). What a machine supports is found by
:mod:`octasplat.workers.sandbox.capabilities`.
"""
