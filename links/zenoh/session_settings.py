"""Settings of a Zenoh session: mutual TLS, access control, and behaviour on a full connection.

- Mode `router` at the hub, `client` at the other hosts, no scouting: one connection from each host to the hub.
- TLS only, with certificates at both ends; the hub's contains its address. Only hosts of the authority are accepted.
- Access control at both ends by the certificate's common name, default deny: a host may publish only the keys of its
  own nodes, and the clients accept only the hub.
- so_sndbuf 64 kB: bytes in the kernel's buffer cannot be dropped, and at 30 Mbit/s 2 MB are half a second.
- lease 2 s with 100 keep-alives, one per 20 ms: Zenoh does not flush its TLS stream. When the socket was full, the last
  64 kB of a message wait for the next write, such as a keep-alive. With the default, messages arrived 2.5 s late.
- wait_before_close 3 s: a message (complete, not each fragment) that is not sent by then closes the connection, which
  is then reopened. Therefore 2 MB need 5.3 Mbit/s, and a broken connection blocks a sender for that time.
- Connect without timeout: otherwise a client with a broken connection stops reconnecting.

Source: https://zenoh.io/docs/manual/access-control and /tls, Zenoh 1.10.2's defaults, and measurements
(tests/benchmarks/system/bench_hosts.py, tests/links/zenoh).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from flow.config.hosts import Hop, Hosts

ROOT = "grd"
SEND_BUFFER_BYTES = 65_536
LEASE_MS, KEEP_ALIVES = 2000, 100
WAIT_BEFORE_CLOSE_US = 3_000_000
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
OPENING = {"open_timeout": 2000, "accept_timeout": 2000}  # ms; a lost handshake is repeated
MAX_MESSAGE_BYTES = 20 * 2**20  # more than flow.remote.codec.MAX_BYTES


class SessionSettings(BaseModel):
    """Settings of one host's session: endpoint, files, and the keys in each direction."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str
    hub: str
    endpoint: str
    certificate: Path
    key: Path
    authority: Path
    keys: tuple[tuple[str, str, str], ...] = Field(default=())  # (sender, receiver, key) of all hops of this host

    @property
    def is_hub(self) -> bool:
        """Whether the other hosts connect to this one."""
        return self.host == self.hub

    @property
    def others(self) -> tuple[str, ...]:
        """The hosts that this one exchanges messages with."""
        return tuple(dict.fromkeys(host for pair in self.keys for host in pair[:2] if host != self.host))


def session_of(hosts: Hosts, name: str) -> SessionSettings:
    """Session settings of one host."""
    host = hosts.hosts[name]
    hops = [hop for hop in hosts.hops if name in (hop.sender, hop.receiver)]
    return SessionSettings(
        host=name,
        hub=hosts.hub,
        endpoint=host.endpoint,
        certificate=host.certificate,
        key=host.key,
        authority=host.authority,
        keys=tuple((hop.sender, hop.receiver, key_of(hop)) for hop in hops),
    )


def key_of(hop: Hop) -> str:
    """Zenoh key of a hop's messages."""
    return f"{ROOT}/{hop.sender}/{hop.receiver}/{hop.producer}/{hop.output}"


def clock_key(replier: str, requester: str) -> str:
    """Zenoh key of the time requests from one host to another."""
    return f"{ROOT}/clock/{replier}/{requester}"


def config_of(session: SessionSettings) -> dict[str, Any]:
    """Configuration of Zenoh."""
    certificate, key = str(session.certificate), str(session.key)
    tls = {
        "root_ca_certificate": str(session.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "so_sndbuf": SEND_BUFFER_BYTES,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }
    block = {"wait_before_close": WAIT_BEFORE_CLOSE_US}
    tx = {"lease": LEASE_MS, "keep_alive": KEEP_ALIVES, "queue": {"congestion_control": {"block": block}}}
    link = {"protocols": ["tls"], "tls": tls, "tx": tx, "rx": {"max_message_size": MAX_MESSAGE_BYTES}}
    config: dict[str, Any] = {
        "mode": "router" if session.is_hub else "client",
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": link, "unicast": OPENING},
        "access_control": access_control(session),
    }
    if session.is_hub:
        config["listen"] = {"endpoints": [session.endpoint]}
    else:
        config["listen"] = {"endpoints": []}
        config["connect"] = {
            "endpoints": [session.endpoint],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": RETRY,
        }
    return config


def access_control(session: SessionSettings) -> dict[str, Any]:
    """Access rules for the other hosts; everything else is denied."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for other in session.others:
        me = session.host
        incoming = [key for sender, _, key in session.keys if sender == other]
        outgoing = [key for _, receiver, key in session.keys if receiver == other]
        requests_in, requests_out = [clock_key(me, other)], [clock_key(other, me)]
        allowed = {
            ("ingress", "put"): incoming,
            ("ingress", "declare_subscriber"): outgoing,
            ("ingress", "query"): requests_in,
            ("ingress", "declare_queryable"): requests_out,
            ("ingress", "reply"): requests_out,
            ("egress", "put"): outgoing,
            ("egress", "declare_subscriber"): incoming,
            ("egress", "query"): requests_out,
            ("egress", "declare_queryable"): requests_in,
            ("egress", "reply"): requests_in,
        }
        own = [
            {
                "id": f"{other} {flow} {what}",
                "permission": "allow",
                "flows": [flow],
                "messages": [what],
                "key_exprs": keys,
            }
            for (flow, what), keys in allowed.items()
            if keys
        ]
        rules += own
        policies.append({"id": other, "rules": [rule["id"] for rule in own], "subjects": [other]})
    subjects = [{"id": other, "cert_common_names": [other]} for other in session.others]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
