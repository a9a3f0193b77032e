"""Shape a cable with two robot grippers: simulate it, learn its dynamics, correct them online, plan with them.

Importing this package imports neither JAX nor MuJoCo; its modules do.
"""

import os

# jaxlib 0.10.2 can deadlock in batched MJX steps when XLA's CPU thread pool has only two threads, as it has on a
# two-core machine. XLA reads NPROC once, when JAX first computes, so it is set here unless somebody has decided.
if len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)) < 4:
    os.environ.setdefault("NPROC", "4")

__version__ = "1.0.0"
