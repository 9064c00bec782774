"""The lab's configuration: the models behind `lab.toml`, their validation and the template."""
