"""The JSON output of the commands: one model for each kind of output, with a name and a version.

A command builds its model, and `model.print_json` prints it. `catalog` lists the models by command; `make gen` writes
their JSON Schemas to docs/json/ and the page docs/json-output.md. A field may be added to a version. A field that is
removed or renamed, or that changes its type or meaning, needs the next version.
"""
