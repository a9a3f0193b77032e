"""MJX, imported without the two lines that it prints where Warp, which nothing here needs, is not installed."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
