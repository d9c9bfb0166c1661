"""A fake network camera: RTSP on a local socket, with numbered H.264 images as RTP between its replies.

Source: RFC 2326, 10 (methods) and 10.12 (RTP inside the connection); RFC 3550, 5.1 (RTP's header); RFC 6184, 5.6 and 5.8
(one NAL unit in a packet, and in pieces, FU-A), 8.1 (parameter sets in the description); RFC 7617 (Basic).
"""

from __future__ import annotations

import base64
import select
import socket
import struct
import threading
from contextlib import suppress

from links.clock import host_time
from tests.links.camera import h264_by_hand as h264

PACKET = 1400  # bytes of a NAL unit in one packet, as on Ethernet
CLOCK_HZ = 90_000


class RtspCamera:
    """Sends to one client at a time. `stop` closes the connection, `start` uses the same port again."""

    def __init__(self, period_s, user=None):
        self.start_ns, self.requests, self.port = {}, [], 0  # send time per image; methods of each connection
        self.silent = False  # connected, but sends nothing
        self._period_s, self._user, self._number = period_s, user, 0
        self.start()

    def start(self):
        self._running = True
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self._listener.settimeout(0.05)
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def stop(self):
        self._running = False
        self._thread.join()

    @property
    def url(self):
        return f"rtsp://{self._user + '@' if self._user else ''}127.0.0.1:{self.port}/live"

    def _serve(self):
        with self._listener:
            while self._running:
                try:
                    client, _ = self._listener.accept()
                except TimeoutError:
                    continue
                with client:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self.requests.append([])
                    with suppress(OSError):  # the client went away
                        ClientConnection(client, self._user, self._period_s, self.requests[-1]).run(self._images())

    def _images(self):
        """(number, NAL units) once per period, None between; the first image of a client is an IDR."""
        self._number += -self._number % h264.GROUP
        due_ns = host_time.now_ns()
        while self._running:
            if self.silent or host_time.now_ns() < due_ns:
                yield None
                continue
            units = h264.image(self._number)
            self.start_ns[self._number] = host_time.now_ns()
            yield self._number, units
            self._number += 1
            due_ns += round(1e9 * self._period_s)


class ClientConnection:
    """The connection of one client."""

    def __init__(self, client, user, period_s, requests):
        self._client, self._user, self._period_s, self._requests = client, user, period_s, requests
        self._received, self._sequence, self._playing = b"", 0, False

    def run(self, images):
        """Reply, and send between PLAY and TEARDOWN, until either side closes."""
        for image in images:
            while select.select([self._client], [], [], 0 if image else 0.002)[0]:
                data = self._client.recv(65536)
                self._received += data
                if not data or not self._reply_all():
                    return
            if image and self._playing:
                number, units = image
                for unit in units:
                    self._send(unit, number, last=unit is units[-1])

    def _reply_all(self):
        while self._received:
            if self._received[:1] == b"$":  # the client's RTCP
                size = 4 + int.from_bytes(self._received[2:4].ljust(2, b"\xff"))
                if len(self._received) < size:
                    return True
                self._received = self._received[size:]
                continue
            head, ended, rest = self._received.partition(b"\r\n\r\n")
            if not ended:
                return True
            self._received = rest
            if not self._reply(head.decode().split("\r\n")):
                return False
        return True

    def _reply(self, lines):
        method = lines[0].split()[0]
        fields = dict(line.split(": ", 1) for line in lines[1:])
        self._requests.append(method)
        status, head, body = "200 OK", {"CSeq": fields["CSeq"], "Session": "7"}, ""
        if self._user and fields.get("Authorization") != f"Basic {base64.b64encode(self._user.encode()).decode()}":
            status, head["WWW-Authenticate"] = "401 Unauthorized", 'Basic realm="camera"'
        elif method == "OPTIONS":
            head["Public"] = "DESCRIBE, SETUP, PLAY, TEARDOWN, GET_PARAMETER"
        elif method == "DESCRIBE":
            body = description()
            head |= {"Content-Type": "application/sdp", "Content-Length": str(len(body))}
        elif method == "SETUP" and "TCP" not in fields["Transport"]:
            status = "461 Unsupported Transport"
        elif method == "SETUP":
            head["Transport"] = "RTP/AVP/TCP;unicast;interleaved=0-1"
        elif method == "PLAY":
            self._playing = True
        text = "\r\n".join([f"RTSP/1.0 {status}", *(f"{k}: {v}" for k, v in head.items())])
        self._client.sendall(f"{text}\r\n\r\n{body}".encode())
        return method != "TEARDOWN"

    def _send(self, unit, number, last):
        if len(unit) <= PACKET:
            return self._send_packet(unit, number, last)
        pieces = [unit[at : at + PACKET] for at in range(1, len(unit), PACKET)]
        for piece in pieces:
            first, final = piece is pieces[0], piece is pieces[-1]
            head = bytes([unit[0] & 0xE0 | 28, first << 7 | final << 6 | unit[0] & 0x1F])
            self._send_packet(head + piece, number, last and final)
        return None

    def _send_packet(self, payload, number, last):
        stamp = round(number * CLOCK_HZ * self._period_s) % 2**32
        rtp = struct.pack(">BBHII", 0x80, last << 7 | 96, self._sequence % 2**16, stamp, 7) + payload
        self._sequence += 1
        self._client.sendall(b"$\0" + len(rtp).to_bytes(2) + rtp)


def description():
    """SDP description of the stream."""
    sets = ",".join(base64.b64encode(unit).decode() for unit in (h264.sequence(), h264.picture_parameters()))
    lines = [
        "v=0",
        "o=- 0 0 IN IP4 127.0.0.1",
        "s=camera",
        "c=IN IP4 0.0.0.0",
        "t=0 0",
        "m=video 0 RTP/AVP 96",
        f"a=rtpmap:96 H264/{CLOCK_HZ}",
        f"a=fmtp:96 packetization-mode=1;sprop-parameter-sets={sets}",
        "a=control:track0",
    ]
    return "".join(f"{line}\r\n" for line in lines)
