"""What every runner does at a port: call the handler, check its outputs, name its errors.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Generic, TypeVar, cast

from flow.link import LinkError, Record, Source
from flow.message import Message, check_arrays

F = TypeVar("F")


class RunError(Exception):
    """A stage or link raised while the graph ran. The text names node, port and time; the cause is chained."""


class RemoteError(Exception):
    """What a node in another process raised, with its type's name, as text."""


class Output(Generic[F]):
    """One output of one running node: its name, the number of its messages, and the ports and taps that take them."""

    __slots__ = ("checked", "count", "feeds", "name", "seen_by")

    def __init__(
        self, name: str, feeds: list[F], seen_by: tuple[Callable[[str, Message, int], None], ...] = ()
    ) -> None:
        self.name, self.feeds, self.seen_by = name, feeds, seen_by
        self.count, self.checked = 0, False


def call(name: str, handler: Callable[[Any], Any], message: Any, arrival_ns: int) -> tuple[Message, ...]:
    """What a handler gives for one message: none, one, or several messages.

    RunError: what it raised; a link's LinkError is raised as it is.
    """
    try:
        result = handler(message)
        if result is None:
            return ()
        return (result,) if isinstance(result, Message) else tuple(result)  # a generator does its work here
    except (LinkError, RunError):
        raise  # its text is complete
    except Exception as error:
        text = str(error) if isinstance(error, RemoteError) else f"{type(error).__name__}: {error}"
        raise RunError(f"{name} failed at {arrival_ns / 1e9:.6f} s: {text}") from error


@contextmanager
def named(what: str) -> Generator[None]:
    """`with named("lidar.listen"): ...`: an exception within becomes a RunError; a LinkError is raised as it is."""
    try:
        yield
    except (LinkError, RunError):
        raise
    except Exception as error:
        raise RunError(f"{what} failed: {type(error).__name__}: {error}") from error


def admit(name: str, outputs: Mapping[type[Message], Output[F]], message: Message, strict: bool) -> Output[F]:
    """The output of a message. RunError: its class is not declared as an output, or its arrays are not as declared.

    Arrays are checked for the first message of each output, and always with `strict`.
    """
    output = outputs.get(type(message))
    if output is None:
        given = type(cast(Any, message)).__name__
        raise RunError(f"{name} gave a {given}, which its annotation does not declare")
    if strict or not output.checked:
        output.checked = True
        try:
            check_arrays(message)
        except TypeError as error:
            raise RunError(f"{output.name}: {error}") from None
    return output


def decoded(
    name: str, source: Source, record: Record, outputs: dict[type[Message], Output[Any]], strict: bool
) -> list[tuple[Output[Any], Message]]:
    """A record's messages, each with its output. LinkError or RunError: the record cannot be decoded."""
    where = f"{name}.decode"
    given = call(where, source.decode, record, record.arrival_ns)
    return [(admit(where, outputs, message, strict), message) for message in given]
