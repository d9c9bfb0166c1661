"""What a candidate is: a drone, or what else returns pulses in the sky, and why, in words.

A drone is weighed against each other thing that returns pulses in the sky, with the evidence that tells the two apart:

    stray       rain, dust, a wrong return     it is not there at the next look
    clutter     lamp, wire, tree, roof edge    something stands beside it, it returns little, it does not move
    bird                                       it is fast, or turns hard
    balloon                                    it is smooth and round

Where the drone tells how it flies, that decides over still things, birds and balloons
(stages/detect/motion_log_ratios.py).

    ln of the odds of a drone = -ln sum_k exp(-o_k),     o_k = ln of the odds, drone over thing k
    (where the drone tells nothing: a share of that and an offset; from `sure` on a share of what is more)

Every o_k is a prior and a sum of log likelihood ratios, capped where looks repeat the same evidence. What is smaller
than a drone (drops, insects, birds) returns pulses nearby only, so strays' and birds' priors depend on the range.

The numbers are ours: reasoned, then changed on some dozens of matrix flights (seeds 901 to 921). `unseen_m` and
`again` were changed after flights of the matrix (seeds 1 to 3) went wrong; `alone_near` and `rugged` after how often
drones and other things showed each (as built, seeds 21 to 24), `look` and `look_far` after what came of them (seeds 16
to 35). The priors of strays, birds and balloons are fitted, last of all, to what was a drone in 195 flights (as built,
seeds 31 to 35), so that P is how often it is one; those of birds and balloons nearby less than the fit would have it,
as what was accepted there was right. `weight_sure` is fitted to what became of the likely ones in 385 others (seeds 41
to 45 and 56 to 60). What a drone that tells nothing is judged by is of before (`untold`; its weight and offset fitted
to 116 flights, seeds 6 to 8). What P is worth in flights not seen then stands in `docs/RESULTS.md`.

Source: ours; weight and offset after Platt, Advances in Large Margin Classifiers (1999); DESIGN, "a small cluster with
*measured* emptiness around it, evaluated as data arrives".
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import BaseModel, ConfigDict

from stages.detect.candidate import OPEN_BESIDE, Candidate
from stages.kernels.detect.isolation import SECTORS
from stages.kernels.detect.motion_log_ratios import SWAY_M

STANDING = "a lamp, wire or edge"
MOVED = 3.0  # nats by its telemetry, from which on it has clearly moved as the drone says; less far, it says no more
UNSURE = 2.3  # ln of odds, below which it is said what else it may be

# ln of how much likelier a drone flies so than a bird, by the speed it reaches; of birds there are several
FLIGHT_MPS = (0.0, 2.0, 4.0, 6.0, 9.0, 12.0)
FLIGHT_NATS = (1.0, 1.0, 0.0, -2.0, -4.0, -7.0)


class Evidence(BaseModel):
    """How much each observation counts [nats], drone over the other thing, and where the caps are."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    small_m: float = 14.0  # up to this range strays and birds return pulses as drones do; from unseen_m on hardly any
    stray: float = -7.4  # prior, nearby: of what is hit once, one in 1600 is there again;
    stray_far: float = 0.7  # far off two of three
    stray_untold: float = -5.0  # at any range, where the drone does not tell how it flies
    hit: float = 1.0  # each return of the first look, up to 4
    look: float = 4.0  # each further look with a return, up to wire_m,
    look_far: float = 2.5  # and from unseen_m on: there looks are further apart, and more is met again by chance
    miss: float = 0.25  # each pulse that went through the middle
    far_m: float = 35.0  # beyond, ever less of what returns anything is a drone
    far: float = 0.15  # each metre

    clutter: float = -6.0  # prior, assumed: of short things in the sky one in 400 hangs free
    free_sector: float = 0.6  # each of eight sectors that pulses flew through
    beside: float = -3.0  # each look with something in a sector, recently
    most_beside: float = 12.0
    most_beside_flown: float = 4.0  # where it had flown in the open before, as the drone says: it came to a wall
    alone: float = 0.3  # each look with nothing, up to most_alone
    alone_near: float = 0.7  # and so much more up to near_m, where a wire or pole returns pulses in each look,
    near_m: float = 10.0
    not_near_m: float = 16.0  # none from here on
    most_alone: float = 2.0
    near_alone: float = 3.0  # nearby up to so much more: there a wire that held it would return pulses, too
    wire_m: float = 20.0  # up to this range,
    unseen_m: float = 30.0  # and none from here on
    most_few: float = 6.0  # looks with a single return: a wire gives little else
    most_many: float = 2.0  # and those with more
    near_big: float = 8.0  # a wall, crown or trunk this close, and it has not moved away
    spread: float = 3.0  # its sightings lie wider about a straight flight than a drone is large
    long: float = 1.5  # each look longer than the drone, up to 4
    moves: float = 5.0  # it moved: what stands does not
    hung: float = 1.8  # it does not, and hangs where what would hold it may be unseen;
    hung_m: float = 28.0  # from here on a drone that hangs and a lamp are not told apart,
    most_hung: float = 3.3  # so that it is never more likely one than that
    still: float = 0.12  # each look at something that does not, up to most_still: a lamp's pole is found sooner
    most_still: float = 1.5
    among: float = 2.0  # something was refused beside it, lately: wires are long
    again: float = 4.0  # and more in the very place, while the drone says that it flies

    weight_untold: float = 0.76  # of all this, where the drone does not tell how it flies, and
    offset_untold: float = -0.37
    sure: float = 1.0  # what is more likely a drone than this (73 %) is one less often than its odds would have it:
    weight_sure: float = 0.72  # looks err together, and what was not thought of is met; so much of the rest is meant
    joined: float = 3.0  # two things that by chance lie as the drone flew; shared by the looks since

    bird: float = -0.5
    calm: float = 8.0  # each second in which it would have shown a bird's speed or turn
    steady: float = 3.0  # each second of straight flight after the first
    most_calm: float = 8.0
    flew_so: float = 10.0  # it flew as only birds do, once
    bird_speed_mps: float = 9.0  # no drone of ours flies faster
    bird_acceleration_mps2: float = 6.0

    birds: float = -3.2  # prior nearby, where the drone tells how it flies: one drone among two dozen birds,
    birds_far: float = -1.2  # far off among three
    told: float = 0.9  # share of what its path says against the drone's telemetry: sightings err together
    most_told: float = 8.0
    least_told: float = -12.0

    balloon: float = 2.2  # prior, and
    balloon_untold: float = 5.0  # where the drone does not tell how it flies
    ball: float = 2.0  # each chord that bulges smoothly: of balloons' nine in ten, of a small drone's half
    rugged: float = 2.4  # each chord with five or more returns that does not
    most_round: float = 8.0  # chords that can tell a balloon: the next ones show the same side of the same thing


def judge(c: Candidate, e: Evidence, free_space: bool, motion_known: bool) -> tuple[float, str]:
    """ln of the odds that it is a drone, and why, in words; what else it would be is noted in `c.suspect`.

    `free_space` False leaves out what was measured around it; `motion_known`: the vehicle tells how it moves.
    """
    clutter, said = over_clutter(c, e, free_space, motion_known)
    over = {
        "a stray return": over_stray(c, e),
        STANDING: clutter,
        "a bird": over_bird(c, e),
        "a balloon": over_balloon(c, e),
    }
    least = min(over, key=lambda name: over[name])
    shift = over[least]
    c.suspect = least
    evidence = shift - math.log(sum([math.exp(shift - value) for value in over.values()]))
    words = [f"{c.hit_looks} looks, {c.hits} returns", *said]
    if c.joined_at:
        evidence -= e.joined / (c.hit_looks - c.joined_at)
        words.append("met again where the drone says it would be")
    if c.motion is not None:
        words.append(f"{c.motion.speed_mps:.1f} +- {c.motion.speed_sigma_mps:.1f} m/s")
    if c.heard is not None and c.heard.denied:
        words.append("it does not fly as the drone says")
    elif c.heard is not None and max(c.heard[:3]) > MOVED:
        far = c.heard.way_m > c.swings_m
        words.append("it flies as the drone says" if far else f"the drone says it went {c.heard.way_m:.1f} m only")
    elif c.heard is None and flew_as_bird(c, e):
        words.append("flew as a bird does")
    if c.heard is None:
        evidence = e.weight_untold * evidence + e.offset_untold
    evidence = as_often(evidence, e)
    if evidence < UNSURE:
        words.append(f"if not a drone, {least}")
    return evidence, "; ".join(words)


def as_often(odds: float, e: Evidence) -> float:
    """ln of the odds of how often it is a drone, of what seems one so much [nats]: less often where that is likely."""
    return odds if odds < e.sure else e.sure + e.weight_sure * (odds - e.sure)


def over_stray(c: Candidate, e: Evidence) -> float:
    """Drone over rain, dust or a wrong return [nats]: that is gone at the next look."""
    look = e.look_far + (e.look - e.look_far) * nearness(c, e)
    prior = e.stray_untold if c.heard is None else e.stray_far + (e.stray - e.stray_far) * smallness(c, e)
    odds = prior + e.hit * min(c.first_hits, 4) + look * (c.hit_looks - 1) - e.miss * c.missed
    return min(odds, 10.0) - e.far * max(c.range_m - e.far_m, 0.0)


def over_clutter(c: Candidate, e: Evidence, free_space: bool, motion_known: bool) -> tuple[float, list[str]]:
    """Drone over a lamp, wire, leaf or edge [nats], and what was noticed."""
    said: list[str] = []
    odds = e.clutter
    flew = c.heard is not None and e.told * c.flown > MOVED
    if free_space:
        free = sum([looks >= 1.0 for looks in c.free.tolist()])
        beside = max(e.beside * c.beside, -(e.most_beside_flown if flew else e.most_beside))
        odds += e.free_sector * free + beside + min(each_alone(c, e) * c.alone, most_alone(c, e))
        said.append(f"{free} of {SECTORS} sectors around it free")
        if c.beside > OPEN_BESIDE:
            said.append("something beside it" + (", to which it flew through the open" if flew else ""))
    few = min(max(c.few, -e.most_few), e.most_many)
    odds += few - e.long * min(c.long_looks, 4)
    if c.single:
        said.append("single returns")
    if c.long_looks:
        said.append("longer than a drone")
    if c.heard is not None:
        wire = c.range_m < (e.unseen_m if c.single else e.wire_m)  # farther off a wire returns little, then nothing
        told = c.heard.over_wire if wire else c.heard.over_still
        shown = c.heard.way_m > c.swings_m  # what stands, met here and there, seems to go as far
        nats = max(believed(told, e, shown), believed(c.flown, e))
        moved = nats > MOVED
        odds += nats
    else:
        moved = c.moves(motion_known)
        odds += e.moves if moved else 0.0
    if not moved:
        odds += min(e.still * c.hit_looks, e.most_still)
        if c.heard is not None:
            odds -= e.hung * (1.0 - nearness(c, e))
        said.append("it may stand still")
        if c.among:
            odds -= e.among + (e.again if c.again else 0.0)
            said.append("something near it was refused")
    if c.big_looks > 0.3 * c.hit_looks and not moved:
        odds -= e.near_big
        said.append("beside something big" + (f" {c.big_m:.1f} m away" if math.isfinite(c.big_m) else ""))
    if c.motion is not None and c.motion.spread_m > 0.35 and len(c.path_ns) > 3:
        odds -= e.spread
        said.append(f"scattered over {c.motion.spread_m:.1f} m")
    if c.heard is not None and not moved and c.range_m > e.hung_m:
        odds = min(odds, e.most_hung)
    return odds, said


def each_alone(c: Candidate, e: Evidence) -> float:
    """What one look with nothing beside it counts [nats]."""
    return e.alone + e.alone_near * share_at(c.range_m, e.near_m, e.not_near_m)


def most_alone(c: Candidate, e: Evidence) -> float:
    """What looks with nothing beside it can count [nats]: a wire is seen nearby, once pulses crossed every sector."""
    crossed = min(max((min(c.free.tolist()) - 2.0) / 6.0, 0.0), 1.0)
    return e.most_alone + e.near_alone * crossed * nearness(c, e)


def nearness(c: Candidate, e: Evidence) -> float:
    """1 where a wire would be seen, 0 where none is."""
    return share_at(c.range_m, e.wire_m, e.unseen_m)


def smallness(c: Candidate, e: Evidence) -> float:
    """1 where things smaller than a drone return pulses, too, 0 where hardly any does."""
    return share_at(c.range_m, e.small_m, e.unseen_m)


def share_at(range_m: float, full_m: float, none_m: float) -> float:
    """1 up to full_m, 0 from none_m on."""
    return min(max((none_m - range_m) / max(none_m - full_m, 1e-9), 0.0), 1.0)


def over_bird(c: Candidate, e: Evidence) -> float:
    """Drone over bird [nats]."""
    if c.heard is not None:
        prior = e.birds_far + (e.birds - e.birds_far) * smallness(c, e)
        return prior + believed(c.heard.over_bird, e)
    odds = e.bird + min(e.calm * c.calm_s + e.steady * max(c.steady_s - 1.0, 0.0), e.most_calm)
    motion = c.gentler
    if motion is not None:
        flight = float(np.interp(motion.top_mps, FLIGHT_MPS, FLIGHT_NATS))
        odds += flight / (1.0 + (motion.top_sigma_mps / 4.0) ** 2)
    return odds - (e.flew_so if flew_as_bird(c, e) else 0.0)


def over_balloon(c: Candidate, e: Evidence) -> float:
    """Drone over balloon [nats]."""
    round_ = e.ball * c.balls - e.rugged * c.rugged
    if round_ > 0.0:
        round_ *= min(e.most_round / (c.balls + c.rugged), 1.0)
    if c.heard is None:
        return e.balloon_untold - round_
    shown = c.heard.way_m > SWAY_M  # one on its string swings as far
    return e.balloon - round_ + believed(c.heard.over_balloon, e, shown)


def believed(told: float, e: Evidence, shown: bool = True) -> float:
    """What a comparison with the drone's telemetry counts [nats]; not `shown` that the drone flies: MOVED at most."""
    return min(max(e.told * told, e.least_told), e.most_told if shown else min(e.most_told, MOVED))


def flew_as_bird(c: Candidate, e: Evidence) -> bool:
    """Whether it once was clearly faster, or turned harder, than a drone of ours."""
    return c.fastest_mps > e.bird_speed_mps or c.hardest_mps2 > e.bird_acceleration_mps2
