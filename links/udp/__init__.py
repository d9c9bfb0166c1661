"""Sources of UDP datagrams with a JSON object each: settings and listener, common to several drivers."""

from links.udp.datagrams import MAX_AGE_S, MAX_AHEAD_S, WRONG_AGE, UdpSettings, age_s, listen_udp

__all__ = ["MAX_AGE_S", "MAX_AHEAD_S", "WRONG_AGE", "UdpSettings", "age_s", "listen_udp"]
