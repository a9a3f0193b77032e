"""What a closed-loop run looks like: figures, an animation, and one self-contained HTML page."""

from cablejax.report.record import RunRecord, pair_by_shape, record_of

__all__ = ["RunRecord", "pair_by_shape", "record_of"]
