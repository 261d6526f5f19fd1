"""The tables of the job service: connections, migrations, and what stands in each table."""
