"""Helpers to draw one message and read the entities: by path, and the numbers and texts in them."""

from __future__ import annotations

import numpy as np
import synthetic

from flow.message import Message
from links.viewer.draw import draw
from links.viewer.entities import Entity
from links.viewer.scene import ViewerScene


def scene(**changes) -> ViewerScene:
    settings = {"mount": synthetic.MOUNT, "history_s": 3.0, "slice_s": 0.1, "max_points": 6000, "trail_s": 20.0}
    return ViewerScene(**(settings | changes))


def drawn(content: Message, name: str, where: ViewerScene | None = None) -> dict[str, Entity]:
    return {entity.path: entity for entity in draw(content, name, where or scene())}


def numbers(batch) -> np.ndarray:
    return np.array(batch.as_arrow_array().to_pylist(), dtype=float)


def values_of(batch) -> list:
    return batch.as_arrow_array().to_pylist()


def document(entity: Entity) -> str:
    return values_of(entity.archetypes[0].text)[0]
