"""What a message becomes, for tests: the marks by path, and the numbers and words in them."""

from __future__ import annotations

import numpy as np
import synthetic

from flow.message import Message
from links.viewer.draw import draw
from links.viewer.scene import Mark, Scene


def scene(**changes) -> Scene:
    settings = {"mount": synthetic.MOUNT, "history_s": 3.0, "slice_s": 0.1, "max_points": 6000, "trail_s": 20.0}
    return Scene(**(settings | changes))


def drawn(content: Message, name: str, where: Scene | None = None) -> dict[str, Mark]:
    return {mark.path: mark for mark in draw(content, name, where or scene())}


def numbers(batch) -> np.ndarray:
    return np.array(batch.as_arrow_array().to_pylist(), dtype=float)


def words(batch) -> list:
    return batch.as_arrow_array().to_pylist()


def page(mark: Mark) -> str:
    return words(mark.parts[0].text)[0]
