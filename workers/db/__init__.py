"""Tables of the job service: connections, migrations, and the rows of each table."""
