"""Configuration files: read, checked, drawn. `flow.graph` has the result."""
