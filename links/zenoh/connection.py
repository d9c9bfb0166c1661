"""A process's one Zenoh session, shared by all its senders and receivers; it also asks the other hosts for their time.

A host that connects and gets no answer from the hub for SILENT_NS opens a new session. Zenoh connects again by itself,
but not always: when the broken line's writer notices after its reader, it closes the new line's half (seen with 1.10.2:
the hub refuses with MAX_LINKS from then on, and what is sent goes nowhere). A new session is somebody else to the hub.

Source: ours; eclipse-zenoh 1.10, https://zenoh-python.readthedocs.io.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flow.link import LinkError
from links.host_time import now_ns
from links.zenoh.peer_clock import PeerClock
from links.zenoh.session import Session, clock_key, config_of
from links.zenoh.wire import RUN, TIME_ANSWER

if TYPE_CHECKING:
    import zenoh

REOPEN_S = 0.5
ASK_FIRST_S, ASK_S = 0.05, 0.5  # between two questions for the time: until there were enough answers, and then
FIRST_ANSWERS = 10
ANSWER_S = 0.4  # a later answer says nothing of use
SILENT_NS = 3_000_000_000
CLOSE_S = 0.5  # a session whose line is stuck closes when it can; the run does not wait for it


@dataclass(eq=False, slots=True)
class Opened:
    """An open session, and whether it is given up. What is declared on it is declared anew on the next one."""

    session: zenoh.Session
    over: threading.Event


class Connection:
    """Opens the session in a thread of its own and keeps asking for the time."""

    def __init__(self, settings: Session) -> None:
        self.settings = settings
        self.clocks = {other: PeerClock() for other in settings.others}
        self._closing = threading.Event()
        self._news = threading.Condition()
        self._opened: Opened | None = None
        self._refused: str | None = None
        self._taken_in = False  # the hub has answered on the newest session
        self._begun_ns = now_ns()
        self._thread = threading.Thread(target=self._run, name="zenoh session", daemon=True)

    def start(self) -> None:
        """Begin to open."""
        self._thread.start()

    def opened(self, timeout_s: float) -> Opened | None:
        """The open session; None when there is none within timeout_s."""
        with self._news:
            self._news.wait_for(lambda: self._opened is not None, timeout_s)
            return self._opened

    def close(self) -> None:
        """Close the session, within CLOSE_S or later by itself."""
        self._closing.set()
        self._thread.join(CLOSE_S)

    def status_with(self, other: str) -> str | None:
        """What is wrong on the line to another host, in words."""
        settings = self.settings
        if self._opened is None and self._refused is not None:
            return f"cannot open {settings.endpoint}: {self._refused}"
        silent_ns = now_ns() - (self.clocks[other].answered_ns or self._begun_ns)
        if silent_ns <= SILENT_NS:
            return None
        if not settings.is_hub and not self._taken_in:
            return (
                f"{settings.hub} does not take us in at {settings.endpoint}: is grd running there, is the address "
                f"right, and are both certificates valid and of the same authority ({settings.authority.name})?"
            )
        return f"{other} has not answered for {silent_ns / 1e9:.0f} s: is it running, is it in reach?"

    def _run(self) -> None:
        import zenoh

        while not self._closing.is_set():
            try:
                config = zenoh.Config.from_json5(json.dumps(config_of(self.settings)))
                session = zenoh.open(config)  # a client's waits until the hub has taken it in
            except zenoh.ZError as error:
                self._refused = str(error).partition(" at /")[0]
                self._closing.wait(REOPEN_S)
                continue
            self._refused = None
            with contextlib.suppress(zenoh.ZError):  # it closed by itself: the next one is opened
                self._use(session)
            closer = threading.Thread(target=_close, args=(session,), name="zenoh close", daemon=True)
            closer.start()
            closer.join(CLOSE_S / 2)  # longer when the line is stuck: nobody waits for that

    def _use(self, session: zenoh.Session) -> None:
        """From the opening of a session to its end."""
        opened = Opened(session, threading.Event())
        try:
            for other in self.settings.others:
                session.declare_queryable(clock_key(self.settings.host, other), _tell_time)
            self._tell(opened)
            self._ask_on(session)
        finally:
            opened.over.set()
            self._tell(None)

    def _ask_on(self, session: zenoh.Session) -> None:
        """Ask all others for their time until the end, or until the hub is lost."""
        since_ns, answers = now_ns(), 0
        self._taken_in = False
        while not (self._closing.is_set() or self._is_lost(since_ns)):
            for other, clock in self.clocks.items():
                answers += _ask(session, self.settings.host, other, clock)
            self._taken_in = answers > 0
            enough = answers >= FIRST_ANSWERS * len(self.clocks)
            self._closing.wait(ASK_S if enough else ASK_FIRST_S)

    def _tell(self, opened: Opened | None) -> None:
        with self._news:
            self._opened = opened
            self._news.notify_all()

    def _is_lost(self, since_ns: int) -> bool:
        """The hub has not answered for long."""
        if self.settings.is_hub:
            return False
        return now_ns() - max(self.clocks[self.settings.hub].answered_ns or 0, since_ns) > SILENT_NS


def _close(session: zenoh.Session) -> None:
    """May take seconds when the line is stuck."""
    import zenoh

    with contextlib.suppress(zenoh.ZError):  # it was given up already: nobody is left to be told
        session.close()


def _tell_time(query: zenoh.Query) -> None:
    with query:
        query.reply(query.key_expr, TIME_ANSWER.pack(RUN, now_ns()))


def _ask(session: zenoh.Session, host: str, other: str, clock: PeerClock) -> int:
    """Ask another host for its time. How many answers of use came: 0 or 1."""
    import zenoh

    asked_ns = now_ns()
    replies = session.get(
        clock_key(other, host),
        timeout=ANSWER_S,
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.DROP,
        express=True,
    )
    for reply in replies:
        arrival_ns = now_ns()
        answer = reply.ok.payload.to_bytes() if reply.ok is not None else b""
        if len(answer) == TIME_ANSWER.size:
            run, told_ns = TIME_ANSWER.unpack(answer)
            clock.answered(run, asked_ns, told_ns, arrival_ns)
            return 1
    return 0


_lock = threading.Lock()
_in_use: dict[Session, tuple[Connection, int]] = {}


@contextmanager
def connected(settings: Session) -> Iterator[Connection]:
    """The connection of these settings, opened for the first who wants it, closed after the last."""
    check_ready(settings)
    with _lock:
        connection, users = _in_use.get(settings) or (Connection(settings), 0)
        if users == 0:
            connection.start()
        _in_use[settings] = connection, users + 1
    try:
        yield connection
    finally:
        with _lock:
            connection, users = _in_use.pop(settings)
            if users > 1:
                _in_use[settings] = connection, users - 1
        if users == 1:
            connection.close()


def check_ready(settings: Session) -> None:
    """LinkError when the library or a file is missing."""
    if importlib.util.find_spec("zenoh") is None:
        raise LinkError("hosts need Eclipse Zenoh: pip install -e '.[hosts]'")
    for file in (settings.certificate, settings.key, settings.authority):
        try:
            with file.open("rb"):
                pass
        except OSError as error:
            raise LinkError(f"{file}: {error.strerror}; links/zenoh/README.md says how to make certificates") from None
