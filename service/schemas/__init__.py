"""Request and response bodies of the API, with examples; one module a subject."""
