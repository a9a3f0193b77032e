"""Fits explanations again without each part of the recordings, and scores them on the held-out part.

Leaving out a motion is pictured by one linear step where that serves (`Fit.held_out_sse`). It does not where episodes
are few, where they have numbers of their own, or where one of them decides on which of several minima a fit ends in:
there a simulator's `Plan.parts` asks for fits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from cablejax.diagnose.evidence import Evidence
from cablejax.diagnose.fit import Fit, Refits, evaluate, improve
from cablejax.diagnose.protocol import Explanation

FOLDS = 6
"""Parts of the episodes that are held out one after the other, at most, where a plan does not say how many."""


def dealt(group: Int[np.ndarray, "E"], parts: int) -> Int[np.ndarray, "E"]:
    """The part that each episode falls to: groups are dealt out whole, the largest first to the smallest part."""
    names, counts = np.unique(group, return_counts=True)
    sizes, part_of = np.zeros(min(parts, len(names)), int), {}
    for name, count in sorted(zip(names, counts, strict=True), key=lambda item: (-item[1], item[0])):
        part_of[name] = int(sizes.argmin())
        sizes[part_of[name]] += count
    return np.array([part_of[name] for name in group])


def independent(group: Int[np.ndarray, "E"]) -> Int[np.ndarray, "E"]:
    """Labels of what is left out, or drawn, together: the groups of episodes, or each by itself where there is one."""
    return group if len(np.unique(group)) > 1 else np.arange(len(group))


def refitted(evidence: Evidence, fits: Sequence[Fit]) -> list[Fit]:
    """The fits with `Refits`, where the simulator's plan asks for them; those that have some stay as they are."""
    plan, todo = evidence.simulator.plan, [i for i, fit in enumerate(fits) if fit.refits is None]
    if plan.parts is None or not todo:
        return list(fits)
    part_of = dealt(independent(evidence.motion), plan.parts)
    if not part_of.any():  # one episode: nothing can be left out
        return list(fits)
    result = list(fits)
    sse, ended, left_out = [np.zeros(len(part_of)) for _ in todo], [[] for _ in todo], []
    for part in range(part_of.max() + 1):
        out, rest = np.flatnonzero(part_of == part), np.flatnonzero(part_of != part)
        left_out.append(out)
        seen, unseen = evidence.restricted(rest), evidence.restricted(out)
        there = improve(seen, [fits[i].restricted(rest) for i in todo], plan.last_steps)
        checks = evaluate(unseen, [_forgotten(unseen, fit.explanation) for fit in there])
        if evidence.simulator.fits_unseen:
            checks = improve(unseen, checks, plan.last_steps, own_only=True)
        for k, check in enumerate(checks):
            sse[k][out] = check.sse
            ended[k].append(check.explanation)
    for k, i in enumerate(todo):
        result[i] = dataclasses.replace(fits[i], refits=Refits(tuple(ended[k]), tuple(left_out), sse[k]))
    return result


def _forgotten(unseen: Evidence, one: Explanation) -> Explanation:
    """Without what was fitted to the recordings of these episodes; as a start it may stay where it is fitted again."""
    if not one.own.size or unseen.simulator.fits_unseen:
        return one
    own = one.own.copy()
    own[np.asarray(unseen.simulator.recording, int)[unseen.episodes]] = 0.0
    return one.moved(one.z, own)
