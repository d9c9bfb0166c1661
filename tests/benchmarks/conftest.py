"""What benchmarks share."""

from __future__ import annotations

import cv2
import pytest


@pytest.fixture
def one_thread():
    """OpenCV works in one thread: figures are of one core."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(threads)
