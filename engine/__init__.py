"""The reconstruction library: photographs with poses in, a scene of flat Gaussians out.

Data flows scene -> rays -> gaussians -> trace -> train -> evaluate -> export;
:mod:`octasplat.engine.pipeline` ties the stages together. The engine knows nothing of HTTP, queues or
terminals.
"""

__version__ = "0.1.0"
