"""Fisheye cameras: recorded JPEG frames to images."""

from links.camera.camera import Camera

__all__ = ["Camera"]
