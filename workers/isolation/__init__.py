"""Processes that cannot do what their work does not need, as far as the kernel takes part.

Parents hide what they know from their children (:mod:`workers.isolation.hiding`). Children that read what others
have made give up the network, what watches over other processes, and the folders of the service, for good
(:mod:`workers.isolation.confining`). What of it a machine can do is said by :mod:`workers.isolation.abilities`.
"""
