"""From what a tracer saw to what a photograph shows: the protocol of shading models, and the models."""
