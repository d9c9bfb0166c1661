"""The Zenoh session of a process, shared by its senders and receivers, which also measures peer clocks.

A client that gets no reply from the hub for SILENT_NS opens a new session. Zenoh usually reconnects by itself, but not
always: when the writer of a broken connection notices the loss after its reader, it closes the new connection (observed
with 1.10.2: the hub then rejects it with MAX_LINKS, and sent messages are lost). A new session is a new client for the
hub.

Source: eclipse-zenoh 1.10, https://zenoh-python.readthedocs.io.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flow.link import LinkError
from links.clock.host_time import now_ns
from links.zenoh.envelope import RUN, TIME_REPLY
from links.zenoh.peer_clock import PeerClock
from links.zenoh.session_settings import SessionSettings, clock_key, config_of

if TYPE_CHECKING:
    import zenoh

REOPEN_S = 0.5
FIRST_REQUEST_S, REQUEST_S = 0.05, 0.5  # period of time requests: until FIRST_REPLIES have arrived, and then
FIRST_REPLIES = 10
REPLY_S = 0.4  # timeout of a time request
SILENT_NS = 3_000_000_000
CLOSE_S = 0.5  # limit of waiting for a session to close; a blocked one closes later


@dataclass(eq=False, slots=True)
class OpenSession:
    """An open session, and the event of its end. Publishers and subscribers are declared again on the next session."""

    session: zenoh.Session
    ended: threading.Event


class ZenohConnection:
    """Opens the session in a thread and requests the time of the other hosts periodically."""

    def __init__(self, settings: SessionSettings) -> None:
        self.settings = settings
        self.clocks = {other: PeerClock() for other in settings.others}
        self._closing = threading.Event()
        self._changed = threading.Condition()
        self._opened: OpenSession | None = None
        self._open_error: str | None = None
        self._accepted = False  # the hub has replied on the newest session
        self._start_ns = now_ns()
        self._thread = threading.Thread(target=self._run, name="zenoh session", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def opened(self, timeout_s: float) -> OpenSession | None:
        """The open session; None: none within timeout_s."""
        with self._changed:
            self._changed.wait_for(lambda: self._opened is not None, timeout_s)
            return self._opened

    def close(self) -> None:
        """Close the session, within CLOSE_S or later in the background."""
        self._closing.set()
        self._thread.join(CLOSE_S)

    def status_of(self, other: str) -> str | None:
        """Error text of the connection to another host; None: it works."""
        settings = self.settings
        if self._opened is None and self._open_error is not None:
            return f"cannot open {settings.endpoint}: {self._open_error}"
        silent_ns = now_ns() - (self.clocks[other].reply_ns or self._start_ns)
        if silent_ns <= SILENT_NS:
            return None
        if not settings.is_hub and not self._accepted:
            return (
                f"{settings.hub} does not accept the connection at {settings.endpoint}: is grd running there, is the "
                f"address correct, and are both certificates valid and of the same authority "
                f"({settings.authority.name})?"
            )
        return f"{other} has not replied for {silent_ns / 1e9:.0f} s: is it running and reachable?"

    def _run(self) -> None:
        import zenoh

        while not self._closing.is_set():
            try:
                config = zenoh.Config.from_json5(json.dumps(config_of(self.settings)))
                session = zenoh.open(config)  # a client blocks until the hub has accepted it
            except zenoh.ZError as error:
                self._open_error = str(error).partition(" at /")[0]
                self._closing.wait(REOPEN_S)
                continue
            self._open_error = None
            with contextlib.suppress(zenoh.ZError):  # it has closed: open the next one
                self._use(session)
            closer = threading.Thread(target=_close, args=(session,), name="zenoh close", daemon=True)
            closer.start()
            closer.join(CLOSE_S / 2)  # a blocked one takes longer in the background

    def _use(self, session: zenoh.Session) -> None:
        """Use a session from its opening to its end."""
        opened = OpenSession(session, threading.Event())
        try:
            for other in self.settings.others:
                session.declare_queryable(clock_key(self.settings.host, other), _reply_time)
            self._set_opened(opened)
            self._request_times(session)
        finally:
            opened.ended.set()
            self._set_opened(None)

    def _request_times(self, session: zenoh.Session) -> None:
        """Request the time of all other hosts until the end, or until the hub is lost."""
        since_ns, replies = now_ns(), 0
        self._accepted = False
        while not (self._closing.is_set() or self._is_lost(since_ns)):
            for other, clock in self.clocks.items():
                replies += _request_time(session, self.settings.host, other, clock)
            self._accepted = replies > 0
            enough = replies >= FIRST_REPLIES * len(self.clocks)
            self._closing.wait(REQUEST_S if enough else FIRST_REQUEST_S)

    def _set_opened(self, opened: OpenSession | None) -> None:
        with self._changed:
            self._opened = opened
            self._changed.notify_all()

    def _is_lost(self, since_ns: int) -> bool:
        """Whether the hub has not replied for SILENT_NS."""
        if self.settings.is_hub:
            return False
        return now_ns() - max(self.clocks[self.settings.hub].reply_ns or 0, since_ns) > SILENT_NS


def _close(session: zenoh.Session) -> None:
    """Close a session; takes seconds if its connection is blocked."""
    import zenoh

    with contextlib.suppress(zenoh.ZError):  # already closed
        session.close()


def _reply_time(query: zenoh.Query) -> None:
    with query:
        query.reply(query.key_expr, TIME_REPLY.pack(RUN, now_ns()))


def _request_time(session: zenoh.Session, host: str, other: str, clock: PeerClock) -> int:
    """Request another host's time; returns the number of valid replies, 0 or 1."""
    import zenoh

    request_ns = now_ns()
    replies = session.get(
        clock_key(other, host),
        timeout=REPLY_S,
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.DROP,
        express=True,
    )
    for reply in replies:
        arrival_ns = now_ns()
        data = reply.ok.payload.to_bytes() if reply.ok is not None else b""
        if len(data) == TIME_REPLY.size:
            run, peer_ns = TIME_REPLY.unpack(data)
            clock.on_reply(run, request_ns, peer_ns, arrival_ns)
            return 1
    return 0


_lock = threading.Lock()
_in_use: dict[SessionSettings, tuple[ZenohConnection, int]] = {}


@contextmanager
def connected(settings: SessionSettings) -> Iterator[ZenohConnection]:
    """The connection with these settings; opened by the first user, closed by the last."""
    check_ready(settings)
    with _lock:
        connection, users = _in_use.get(settings) or (ZenohConnection(settings), 0)
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


def check_ready(settings: SessionSettings) -> None:
    """Raise LinkError when the library or a file is missing."""
    if importlib.util.find_spec("zenoh") is None:
        raise LinkError("several hosts need Eclipse Zenoh: pip install -e '.[hosts]'")
    for file in (settings.certificate, settings.key, settings.authority):
        try:
            with file.open("rb") as stream:
                mode = stat.S_IMODE(os.fstat(stream.fileno()).st_mode)
            if file == settings.key and mode & 0o077:
                raise LinkError(f"{file}: other users can read this key. Restrict it: chmod 600 {file}")
        except OSError as error:
            raise LinkError(
                f"{file}: {error.strerror}; links/zenoh/README.md explains how to create certificates"
            ) from None
