"""Fisheye cameras: JPEG frames, recorded or live from a device, a stream or a file, decoded to images."""

from links.camera.camera import Camera

__all__ = ["Camera"]
