"""Stages: the steps of the method. A stage's ports are read from its method signatures.

    class TrackSettings(Settings):
        radius_m: float = Field(1.0, gt=0)

    class Track(Stage[TrackSettings]):
        def __init__(self, settings: TrackSettings | None = None, /, **values: Any) -> None:
            super().__init__(settings, **values)
            self._state = State()

        def on_points(self, points: SweptPoints) -> Iterator[DroneFix | TrackState]: ...

declares an input port `points` and the outputs `drone_fix` and `track_state`. A stage has no thread, clock, socket,
file or global: its outputs depend only on its inputs.

Source: ours.
"""

from __future__ import annotations

import collections.abc
import functools
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, Generic, Union, cast, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict
from typing_extensions import TypeVar

from flow.message import Message, port_name


class StrictModel(BaseModel):
    """Base of settings and of groups of settings: unknown names and non-finite numbers are errors; immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Settings(StrictModel):
    """Base of the settings of a stage or link: checked when it is made. No setting: this class."""


S = TypeVar("S", bound=Settings, default=Settings, covariant=True)


class Node(Generic[S]):
    """What stages and links share: settings of type `S`, and ports found in the signatures."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset()
    """Input ports that may stay unwired."""

    settings_type: ClassVar[type[Settings]] = Settings
    """The class of `settings`: the argument of the generic base, as in `class Track(Stage[TrackSettings])`.
    A subclass of `Track` with more settings sets it to a subclass of `TrackSettings`."""

    settings: S

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for base in cls.__dict__.get("__orig_bases__", ()):
            for argument in get_args(base):
                settings_type = getattr(argument, "__bound__", argument)  # of a type variable, its bound
                if isinstance(settings_type, type) and issubclass(settings_type, Settings):
                    cls.settings_type = settings_type

    def __init__(self, settings: S | None = None, /, **values: Any) -> None:
        """Take checked settings, or check `values` as settings: `Track(radius_m=0.8)`. pydantic's ValidationError."""
        if settings is not None and values:
            raise TypeError(f"{type(self).__name__} takes settings or their values, not both")
        self.settings = cast(S, self.settings_type(**values)) if settings is None else settings

    @property
    def counters(self) -> Mapping[str, int]:
        """Totals since the start, for people: lost, foreign. A run shows them and writes them at its end.

        A node that rejects inputs returns `flow.counters.Counters`.
        """
        return {}


class Stage(Node[S]):
    """Base of all stages. `on_<port>(self, message: Type) -> outputs` is a port; `__init__` makes the state."""

    def finish(self) -> Iterable[Message] | Message | None:
        """Called once after the last message; may return or yield annotated outputs, as a port does."""
        return None


class PortError(TypeError):
    """A stage's class is invalid (a port without annotation, two outputs of one name)."""


_CONTAINERS = (Union, types.UnionType, collections.abc.Iterator, collections.abc.Iterable, list, tuple)


def _message_types(annotation: Any, where: str) -> Iterator[type[Message]]:
    """Message types in an output annotation: a union, an Iterator/Iterable/list/tuple of them, or None."""
    if annotation in (None, type(None), Ellipsis, Message):  # the bare base class declares nothing
        return
    origin = get_origin(annotation)
    if origin in _CONTAINERS:
        for part in get_args(annotation):
            yield from _message_types(part, where)
    elif isinstance(annotation, type) and issubclass(annotation, Message):
        yield annotation
    else:
        raise PortError(f"{where}: the return annotation has {annotation!r}, which is no message type")


def _hints(cls: type[Node], method: str) -> dict[str, Any]:
    try:
        return get_type_hints(getattr(cls, method))
    except NameError as error:
        raise PortError(
            f"{cls.__name__}.{method}: {error}; import message types at run time, not under TYPE_CHECKING"
        ) from None


@functools.cache
def input_ports(cls: type[Node]) -> dict[str, type[Message]]:
    """Input port -> message type, in the order of the class's methods."""
    ports: dict[str, type[Message]] = {}
    names = [name for base in reversed(cls.__mro__) for name in vars(base) if name.startswith("on_")]
    for name in dict.fromkeys(names):
        hints = _hints(cls, name)
        hints.pop("return", None)
        if len(hints) != 1:
            raise PortError(f"{cls.__name__}.{name}: a port takes one annotated message")
        ((_, wanted),) = hints.items()
        if not (isinstance(wanted, type) and issubclass(wanted, Message)):
            raise PortError(f"{cls.__name__}.{name}: {wanted!r} is no message type")
        ports[name.removeprefix("on_")] = wanted
    return ports


@functools.cache
def output_ports(cls: type[Node]) -> dict[str, type[Message]]:
    """Output port -> message type, from the return annotations of all `on_*`, `finish` and `decode` methods."""
    methods = [f"on_{port}" for port in input_ports(cls)] + [m for m in ("finish", "decode") if hasattr(cls, m)]
    ports: dict[str, type[Message]] = {}
    for name in methods:
        where = f"{cls.__name__}.{name}"
        annotation = _hints(cls, name).get("return")
        for found in _message_types(None if annotation is typing.Any else annotation, where):
            if ports.setdefault(port_name(found), found) is not found:
                raise PortError(f"{where}: two message types share the output name {port_name(found)!r}")
    return ports
