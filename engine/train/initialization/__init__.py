"""The Gaussians, the background and the materials that a training begins with."""
