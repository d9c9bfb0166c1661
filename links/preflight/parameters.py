"""Is the autopilot set up to fuse our poses: its parameters against its profile. They are read, never set.

Source: `links.mavlink.profiles`, which says why each.
"""

from __future__ import annotations

from flow.link import LinkError
from links import host_time
from links.mavlink import Autopilot
from links.mavlink.connection import parse_connection
from links.mavlink.lines import open_connection
from links.mavlink.parameters import Answers, read_parameters
from links.mavlink.profiles import PROFILES, ProfileName, findings
from links.mavlink.signing import Signer
from links.preflight.verdict import Verdict, fail, ok

TIMEOUT_S = 5.0


def ask_parameters(link: Autopilot, timeout_s: float = TIMEOUT_S) -> Answers:
    """Ask for what the profile wants, over a connection of its own: `link` must not be listening. LinkError."""
    if link.settings.connection is None:
        raise LinkError("no connection to the autopilot: set `connection`, as in udpin:127.0.0.1:14550")
    profile = PROFILES[link.settings.profile]
    signer = None if link.settings.signing_key is None else Signer(link.settings.signing_key, host_time.now_ns())
    if signer is not None and signer.status is not None:
        raise LinkError(signer.status)
    connection = open_connection(parse_connection(link.settings.connection), link.settings.sender)
    try:
        return read_parameters(
            connection,
            [wanted.name for wanted in profile.wanted],
            (link.settings.system_id, link.settings.component_id),
            link.settings.own_id,
            integers_bytewise=profile.integers_bytewise,
            timeout_s=timeout_s,
            signer=signer,
        )
    finally:
        connection.close()
        if signer is not None:
            signer.close()


def parameter_check(name: str, profile: ProfileName, answers: Answers) -> Verdict:
    """One verdict that names every parameter that is wrong or did not answer."""
    name = f"{name} parameters"
    if not answers.heard:
        return fail(name, "the autopilot did not answer")
    if not answers.values:
        return fail(name, "none was told: does it hear us, and may this link read parameters?")
    wrong = findings(PROFILES[profile], answers.values)
    if wrong:
        return fail(name, "; ".join(wrong))
    return ok(name, f"all {len(PROFILES[profile].wanted)} as {profile} needs them")
