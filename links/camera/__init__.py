"""Fisheye cameras: JPEG frames, recorded or live from a device, a stream or a file, to images."""

from links.camera.camera import Camera

__all__ = ["Camera"]
