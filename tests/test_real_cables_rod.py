"""A recorded window on which three Newton iterations a time step lost the cable."""

from __future__ import annotations

import numpy as np
import pytest

from cablejax.diagnose.protocol import explanation
from cablejax.recordings.deform import NOMINAL, read_deform, repaired_blocks
from cablejax.simulate.rod import Rod
from cablejax.spatial.accidents import off
from cablejax.spatial.cable import SpatialCable, errors
from cablejax.spatial.identify import EDGES, layout_of
from real_cables.protocol import protocol_windows
from recording_cases import DATA, needs_deform

# EI/rho over the nominal one, damping time [s]; logarithm of the profile; rotation of either clamp [rad].
_VALUES = [
    ((1.021,), (0.0634,), (0.6179, -1.4149, -0.927, 1.206, 0.1034), (1.9436, 0.6676, 0.8754, -0.218)),
    ((0.4281,), (0.124,), (0.6818, -1.1629, -1.0351, 1.1719, 0.3063), (1.4347, 0.3376, 0.5744, -0.5717)),
]
_EFFECTS = ("bending_stiffness", "bending_damping", "stiffness_profile", "gripper_rotation_offset")


@needs_deform
@pytest.mark.parametrize("values", _VALUES)
def test_file_67_of_dlo1_is_not_lost(values):
    windows = protocol_windows(repaired_blocks(read_deform(DATA / "deform" / "DLO1.npz"))[0])
    layout = layout_of(windows, NOMINAL.stiffness_over_density)
    one = explanation(*((layout.named(name), 0, value) for name, value in zip(_EFFECTS, values, strict=True)))
    near = [i for i in range(len(windows)) if windows.name[i] in ("65", "66", "67", "68")]
    some = windows.chosen(near)
    error = errors(SpatialCable(Rod(EDGES, 1, twisting=False), layout, some).motion(one), some)
    assert error[some.name.index("67")] < 0.05 and not off(error).any() and np.isfinite(error).all()
