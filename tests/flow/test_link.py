"""Records that any thread can wait for: the iterator, its end, and its errors."""

from __future__ import annotations

import socket
import threading

import pytest

from flow.config.classes import known_classes
from flow.link import LinkError, PolledRecords, Record, Source
from tests.flow.live_toys import PolledLine
from tests.links.ports import free_port


def test_the_iterator_waits_for_records_and_ends_when_it_is_closed():
    line = PolledLine()
    with line.listen() as records:
        line.put(1, 2)
        assert [next(records).data for _ in range(2)] == [b"1", b"2"]
        threading.Timer(0.1, lambda: line.put(3)).start()
        assert next(records).data == b"3"
        threading.Timer(0.1, records.closed.set).start()
        assert list(records) == []


def test_an_error_of_the_source_is_raised_by_the_iterator():
    line = PolledLine()
    with line.listen() as records:
        line.put("cut")
        with pytest.raises(LinkError, match="is it plugged in"):
            next(records)


def test_records_before_an_error_are_given_before_it():
    class Ending(PolledRecords):
        wait_s = 0.0

        def pending(self):
            yield Record("/numbers", 1, 1, b"1")
            raise LinkError("that was all")

    records = Ending()
    assert next(records).data == b"1"
    with pytest.raises(LinkError, match="that was all"):
        next(records)


class Torn(PolledRecords):
    """Waits for a file that is closed meanwhile, with or without the records."""

    def __init__(self, file: socket.socket, closed: bool) -> None:
        super().__init__()
        self._file, self._with_records = file, closed

    @property
    def files(self) -> list[socket.socket]:
        self._file.close()
        if self._with_records:
            self.closed.set()
        return [self._file]

    def pending(self) -> list:
        return []


@pytest.mark.parametrize("closed", [True, False])
def test_a_closed_file_is_an_error_unless_the_records_are_closed(closed):
    near, far = socket.socketpair()
    with far:
        records = Torn(near, closed)
        if closed:
            assert list(records) == []
        else:
            with pytest.raises(ValueError, match="file descriptor"):
                next(records)


POLLED = [cls for cls in known_classes("links").values() if issubclass(cls, Source) and cls.polled]


def test_the_lidar_the_servo_and_the_odometry_can_share_a_thread():
    assert {cls.__name__ for cls in POLLED} == {"Clock", "Cues", "Lidar", "Servo", "VehicleOdometry"}


@pytest.mark.parametrize("cls", [cls for cls in POLLED if cls.__name__ != "Servo"])  # opened: test_dynamixel_live.py
def test_a_source_that_can_share_a_thread_gives_polled_records(cls):
    config = {} if cls.__name__ == "Clock" else {"port": free_port()}
    with cls(**config).listen() as records:
        assert isinstance(records, PolledRecords)
        assert list(records.pending()) == []
