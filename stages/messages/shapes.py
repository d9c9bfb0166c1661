"""Array types that several messages have, beyond those of `flow/message.py`."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flow.message import Shape

Mat6 = Annotated[NDArray[np.float64], Shape(6, 6)]
