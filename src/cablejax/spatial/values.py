"""Values of all parameters: what all recordings share, and what is each recording's own."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True)
class Values:
    """Parameters of one cable.

    Attributes:
        shared: by all recordings, shape [P].
        recordings: that have values of their own, ascending, shape [R].
        own: what each adds to the shared values, shape [R, P].
    """

    shared: Float[np.ndarray, "P"]
    recordings: Int[np.ndarray, "R"]
    own: Float[np.ndarray, "R P"]

    def of(self, group: Int[np.ndarray, "W"]) -> Float[np.ndarray, "W P"]:
        """Values of windows that are part of these recordings; one that is not among `recordings` has the shared."""
        result = np.repeat(self.shared[None], len(group), axis=0)
        for recording, own in zip(self.recordings, self.own, strict=True):
            result[group == recording] += own
        return result

    def covering(self, group: Int[np.ndarray, "W"]) -> Values:
        """With the recordings of `group` among `recordings`."""
        recordings = np.union1d(self.recordings, group)
        own = np.zeros((len(recordings), len(self.shared)))
        own[np.searchsorted(recordings, self.recordings)] = self.own
        return Values(self.shared, recordings, own)

    def of_size(self, size: int) -> Values:
        """The first parameters only, or with more of them that are 0."""
        kept, more = min(size, len(self.shared)), max(size - len(self.shared), 0)
        own = np.pad(self.own[:, :kept], ((0, 0), (0, more)))
        return dataclasses.replace(self, shared=np.pad(self.shared[:kept], (0, more)), own=own)

    def without(self, off) -> Values:
        """With the parameters `off`, shape [P], at 0."""
        return dataclasses.replace(self, shared=np.where(off, 0.0, self.shared), own=np.where(off, 0.0, self.own))


def shared_by_all(values: Float[np.ndarray, "P"], group: Int[np.ndarray, "W"]) -> Values:
    """Values without anything of a recording's own."""
    recordings = np.unique(group)
    return Values(np.asarray(values, float), recordings, np.zeros((len(recordings), len(values))))


def mean_of(one: Values, other: Values) -> Values:
    """Of fits to two parts of the same recordings: mean of what is shared, and of what was found for a recording."""
    found = (one.own != 0).astype(int) + (other.own != 0)
    return Values((one.shared + other.shared) / 2, one.recordings, (one.own + other.own) / np.maximum(found, 1))


def to_json(values: Values) -> dict[str, list]:
    return {field.name: getattr(values, field.name).tolist() for field in dataclasses.fields(values)}


def from_json(kept: dict[str, list]) -> Values:
    shared, recordings = np.array(kept["shared"], float), np.array(kept["recordings"], int)
    return Values(shared, recordings, np.array(kept["own"], float).reshape(len(recordings), len(shared)))
