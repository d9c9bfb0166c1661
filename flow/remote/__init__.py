"""Nodes that run in other processes and on other hosts: messages as bytes, worker processes."""
