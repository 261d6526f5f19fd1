"""What the API takes and gives, with examples; one module a subject."""
