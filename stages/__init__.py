"""The method: messages, geometry, and one file per step of the paper."""
