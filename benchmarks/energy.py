"""The energy that a GPU has used, by NVIDIA's management library where the driver brings it."""

from __future__ import annotations

import ctypes


class EnergyMeter:
    """Reads the energy counter of GPU 0 through `libnvidia-ml`, which changes no setting of the card."""

    def __init__(self):
        self._library, self._device = None, ctypes.c_void_p()
        try:
            library = ctypes.CDLL("libnvidia-ml.so.1")
        except OSError:
            return
        found = library.nvmlInit_v2() == 0 and library.nvmlDeviceGetHandleByIndex_v2(0, ctypes.byref(self._device)) == 0
        if found:
            self._library = library

    def joules(self) -> float | None:
        """Energy since the driver was loaded [J]; None where the card or the driver does not count it."""
        if self._library is None:
            return None
        millijoules = ctypes.c_ulonglong()
        failed = self._library.nvmlDeviceGetTotalEnergyConsumption(self._device, ctypes.byref(millijoules))
        return None if failed else 1e-3 * millijoules.value
