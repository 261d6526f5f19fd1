"""Actions of the service, shared by the API's routes and the web pages; one module a subject.

An action takes the service, the principal and plain values; it returns rows or views and raises problems. It
knows nothing of HTTP requests and responses.
"""
