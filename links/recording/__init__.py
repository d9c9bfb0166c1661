"""Recordings: all inputs as raw bytes in one MCAP file; recordings/README.md documents the format."""

from links.recording.compressed_image import CompressedImage, decode_compressed_image, encode_compressed_image
from links.recording.format import TOPICS, Progress, Topic
from links.recording.reader import RecordingReader
from links.recording.recorder import Recorder
from links.recording.recover import RecoverReport, recover
from links.recording.session import Session
from links.recording.writer import RecordingWriter

__all__ = [
    "TOPICS",
    "CompressedImage",
    "Progress",
    "Recorder",
    "RecordingReader",
    "RecordingWriter",
    "RecoverReport",
    "Session",
    "Topic",
    "decode_compressed_image",
    "encode_compressed_image",
    "recover",
]
