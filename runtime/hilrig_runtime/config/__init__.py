"""The lab's configuration: the schema of `lab.toml`, its validation and its template."""
