"""Models of settings: their base, marks of fields, former names, and refusals."""
