"""Finds effects that are indistinguishable on the motions of a log, by the simulator that has both.

In slow motion stiffness, friction and density act as one number, mu w / EI. A case is an honest test of the name only
where that number's other readings would look different; where they would not, its label says so beforehand.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from .effects import Setup
from .record import gap, quick, record

if TYPE_CHECKING:
    from .cases import Draft
    from .plan import Case


def twins(case: Case, draft: Draft) -> dict[str, float]:
    """Gap over noise that is left when the named other effect, at the equivalent strength, stands in for the true one.

    Family A answers for all families. Zero where a stated value of another effect reproduces the log; empty where there
    is no candidate.
    """
    name = case.effects[0]
    parameters, world = draft.parameters[0], draft.world
    if name == "bending_stiffness":
        number = 1.0 / parameters["ratio"]
    elif name == "linear_density":
        number = parameters["ratio"]
    elif name == "table_friction":
        number = parameters["coefficient"] / world.friction
    else:
        return {}
    candidates = {
        "bending_stiffness": dataclasses.replace(world, stiffness=world.stiffness / number),
        "table_friction": dataclasses.replace(world, friction=world.friction * number),
        "linear_density": dataclasses.replace(world, linear_density=world.linear_density * number),
    }
    true = record(draft.setup, draft.commands, quick)
    return {
        other: round(gap(record(Setup(candidate), draft.commands, quick), true)[0] / draft.noise, 3)
        for other, candidate in candidates.items()
        if other != name
    }
