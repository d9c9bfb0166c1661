"""What a Zenoh session is opened with: TLS both ways, who may say what, and how a full line behaves.

- Mode router at the hub, client elsewhere, no scouting: one line from each host to the hub, nobody looks for others.
- TLS alone, both ends show a certificate, the hub's names its address: only hosts of our authority get in.
- Access control at both ends, by the certificate's common name, nothing allowed that is not named: a host says its own
  nodes' keys and no others, and the hosts believe nobody but the hub.
- so_sndbuf 64 kB: what the kernel has taken cannot be taken back, and at 30 Mbit/s 2 MB are half a second.
- lease 2 s with 100 keep-alives, one each 20 ms: Zenoh does not flush its TLS stream. When the socket was full, the
  last 64 kB of a message wait for the next write; a keep-alive is one. With the usual 2.5 s, messages came 2.5 s late.
- wait_before_close 3 s: a message (whole, not each fragment) that is not through by then closes the line, which is
  opened again. So 2 MB need 5.3 Mbit/s; and a cut line holds a sender for that long.
- Connect without time-out: else a client whose line broke gives up.

Source: https://zenoh.io/docs/manual/access-control and /tls, and Zenoh 1.10.2's own defaults; the rest was measured
(tests/benchmarks/bench_hosts.py, tests/links/zenoh).
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
OPENING = {"open_timeout": 2000, "accept_timeout": 2000}  # ms; a greeting that the line swallowed is begun anew
MAX_MESSAGE_BYTES = 20 * 2**20  # more than flow.remote.codec.MAX_BYTES


class Session(BaseModel):
    """One host's session: how to open it, and which keys go which way."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: str
    hub: str
    endpoint: str
    certificate: Path
    key: Path
    authority: Path
    keys: tuple[tuple[str, str, str], ...] = Field(
        default=()
    )  # (sender, receiver, key), of all that this host is part of

    @property
    def is_hub(self) -> bool:
        """The others connect to this one."""
        return self.host == self.hub

    @property
    def others(self) -> tuple[str, ...]:
        """The hosts at the other end of this one's lines."""
        return tuple(dict.fromkeys(host for pair in self.keys for host in pair[:2] if host != self.host))


def session_of(hosts: Hosts, name: str) -> Session:
    """The session of one of the hosts."""
    host = hosts.hosts[name]
    hops = [hop for hop in hosts.hops if name in (hop.sender, hop.receiver)]
    return Session(
        host=name,
        hub=hosts.hub,
        endpoint=host.endpoint,
        certificate=host.certificate,
        key=host.key,
        authority=host.authority,
        keys=tuple((hop.sender, hop.receiver, key_of(hop)) for hop in hops),
    )


def key_of(hop: Hop) -> str:
    """The key that a hop's messages are published under."""
    return f"{ROOT}/{hop.sender}/{hop.receiver}/{hop.producer}/{hop.output}"


def clock_key(asked: str, asker: str) -> str:
    """The key under which one host asks another for its time."""
    return f"{ROOT}/clock/{asked}/{asker}"


def config_of(session: Session) -> dict[str, Any]:
    """Zenoh's configuration."""
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


def access_control(session: Session) -> dict[str, Any]:
    """Who may say what on this host's lines: nothing that is not named here."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for other in session.others:
        me = session.host
        theirs = [key for sender, _, key in session.keys if sender == other]
        ours = [key for _, receiver, key in session.keys if receiver == other]
        asks_us, we_ask = [clock_key(me, other)], [clock_key(other, me)]
        allowed = {
            ("ingress", "put"): theirs,
            ("ingress", "declare_subscriber"): ours,
            ("ingress", "query"): asks_us,
            ("ingress", "declare_queryable"): we_ask,
            ("ingress", "reply"): we_ask,
            ("egress", "put"): ours,
            ("egress", "declare_subscriber"): theirs,
            ("egress", "query"): we_ask,
            ("egress", "declare_queryable"): asks_us,
            ("egress", "reply"): asks_us,
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
