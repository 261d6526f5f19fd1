"""What can be done, for the API's routes and the pages alike; one module a subject.

An action takes the service, who asks, and plain values; it gives rows or views, and raises problems. Of
requests, answers and their headers it knows nothing.
"""
